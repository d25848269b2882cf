"""Table of independent clients: ``python benchmarks/clients.py`` (as root: lxi asks the portmapper's port).

Runs the tests that carry the marker ``client``: each lets a program by others operate simulators, compares
what it received with what they show, and asserts that they saw no violation of their protocol. Clients that
are not installed are named. ``--write`` puts the table into docs/benchmarks/instruments.md.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks" / "instruments.md"
BEGIN, END = "<!-- written by benchmarks/clients.py -->", "<!-- end -->"
TESTS = ("tests/drivers", "tests/sims/test_laboratory.py")
COMMANDS = {
    "lxi": ["lxi", "--version"],
    "arv-tool": ["arv-tool-0.8", "--version"],
    "arv-camera-test": ["arv-camera-test-0.8", "--help"],
}


def named(client: str) -> str:
    """A client, a command or packages, with its version as far as it is installed and tells it."""
    if client not in COMMANDS:
        return ", ".join(f"{name} {_installed(name)}" for name in client.split(", "))
    command = COMMANDS[client]
    if shutil.which(command[0]) is None:
        return f"{client} (absent)"
    said = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    found = re.search(r"\d+(\.\d+)+", said.stdout + said.stderr)
    return f"{client} {found[0]}" if found else client


def _installed(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "(absent)"


@dataclass
class Row:
    """Outcomes of one client with one set of operations."""

    simulators: dict[str, None] = field(default_factory=dict)
    passed: int = 0
    trouble: dict[str, None] = field(default_factory=dict)


class Table:
    """Plugin of pytest: collects the outcomes of the tests of clients."""

    def __init__(self) -> None:
        self.rows: dict[tuple[str, str], Row] = {}
        self._of: dict[str, tuple[tuple[str, str], str]] = {}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Note what each test is about."""
        for item in items:
            mark = item.get_closest_marker("client")
            assert mark is not None
            client, simulator, operations = mark.args
            given = getattr(getattr(item, "callspec", None), "params", {})
            self._of[item.nodeid] = ((client, operations), simulator.format_map(given))
            self.rows.setdefault((client, operations), Row())

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take over an outcome."""
        key, simulator = self._of[report.nodeid]
        row = self.rows[key]
        if report.when == "call" or not report.passed:
            row.simulators[simulator] = None
        if report.when == "call" and report.passed:
            row.passed += 1
        elif report.skipped and isinstance(report.longrepr, tuple):
            row.trouble[f"not run: {report.longrepr[2].removeprefix('Skipped: ')}"] = None
        elif report.failed:
            row.trouble[f"**failed**: {report.nodeid}"] = None

    def markdown(self) -> str:
        """The table."""
        lines = ["| client | simulators | operations | tests |", "|---|---|---|---|"]
        clients = {client: named(client) for client, _ in self.rows}
        order = list(clients)
        for (client, operations), row in sorted(self.rows.items(), key=lambda each: order.index(each[0][0])):
            outcome = "; ".join([f"{row.passed} passed"] * bool(row.passed) + list(row.trouble))
            lines.append(f"| {clients[client]} | {', '.join(row.simulators)} | {operations} | {outcome} |")
        return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="Put the table into its page.")
    write = parser.parse_args().write
    table = Table()
    tests = [str(ROOT / path) for path in TESTS]
    status = pytest.main(["-q", "-p", "no:cacheprovider", "-m", "client", *tests], plugins=[table])
    print(table.markdown())
    if write:
        text = PAGE.read_text()
        before, rest = text.split(BEGIN, 1)
        PAGE.write_text(f"{before}{BEGIN}\n\n{table.markdown()}\n{END}{rest.split(END, 1)[1]}")
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
