"""Drivers at real device nodes: a Debian kernel in QEMU, its tests one by one in this report.

What each test does stands in ``guest/check_*.py``. They run in the guest, once; here their outcomes are read
from its JUnit XML.
"""

from __future__ import annotations

import ast
import fcntl
from pathlib import Path
from xml.etree import ElementTree

import pytest

from . import machine, parts

GUEST = Path(__file__).with_name("guest")


def _names() -> list[str]:
    """Tests of the guest, by module and function."""
    return [
        f"{path.stem}.{node.name}"
        for path in sorted(GUEST.glob("check_*.py"))
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]


@pytest.fixture(scope="session")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[ElementTree.Element]]:
    """Outcomes in the guest by the name of the test; it is started once, by whoever comes first."""
    lacking = parts.missing()
    if lacking:
        pytest.skip(lacking)
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if base.name.startswith("popen-") else base) / "rig"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "console.log").exists():
            try:
                machine.run(folder, [])
            except RuntimeError as error:
                pytest.skip(f"the virtual laboratory's parts cannot be had: {error}")
    report = folder / "junit.xml"
    if not report.exists():
        pytest.fail((folder / "console.log").read_text(errors="replace")[-4000:])
    found: dict[str, list[ElementTree.Element]] = {}
    for case in ElementTree.parse(report).iter("testcase"):
        module = case.get("classname", "").rsplit(".", 1)[-1]
        found.setdefault(f"{module}.{case.get('name', '').split('[')[0]}", []).append(case)
    return found


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", _names())
def test_in_the_virtual_laboratory(name: str, laboratory: dict[str, list[ElementTree.Element]]) -> None:
    cases = laboratory.get(name, [])
    assert cases, "it did not run in the guest"
    said = [
        f"{case.get('name')}: {outcome.get('message')}\n{outcome.text}"
        for case in cases
        for outcome in [*case.findall("failure"), *case.findall("error")]
    ]
    assert not said, "\n".join(said)
    skipped = [outcome for case in cases for outcome in case.findall("skipped")]
    if skipped:
        pytest.skip(f"{len(skipped)} of {len(cases)}: {skipped[0].get('message')}")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_kernel_log_has_no_errors(
    laboratory: dict[str, list[ElementTree.Element]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if base.name.startswith("popen-") else base) / "rig"
    assert laboratory
    assert (folder / "status").read_text().strip() in ("0", "1"), (folder / "console.log").read_text()[-4000:]
