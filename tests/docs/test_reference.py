"""The generated reference: every command, option, code, exception and document of the program is in it."""

from __future__ import annotations

import json
import re
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
from typer.main import get_command

from reseau.cli import app
from reseau.cli.program import documents
from reseau.core import errors
from reseau.core.failure import Code

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def generated() -> ModuleType:
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        import generated
    finally:
        sys.path.pop(0)
    return generated


@cache
def sources() -> str:
    """What the packages are written in."""
    return "".join(
        path.read_text("utf-8") for tree in ("src", "drivers") for path in (ROOT / tree).rglob("*.py")
    )


def test_every_command_and_option_has_a_line(generated: ModuleType) -> None:
    pages = generated.command_pages()
    missing = []
    for name, command in get_command(app).commands.items():
        for words, each in generated._walk(command, ["reseau", name]):
            if f"# {' '.join(words)}\n" not in pages[name]:
                missing.append(" ".join(words))
            for parameter in each.params:
                if parameter.name != "help" and not getattr(parameter, "hidden", False):
                    shown = parameter.opts[0] if parameter.opts[0].startswith("-") else parameter.name
                    listed = shown in pages[name] or str(parameter.metavar) in pages[name].replace("\\|", "|")
                    missing += [] if listed else [f"{' '.join(words)} {shown}"]
    assert missing == []
    assert len(pages) == len(get_command(app).commands) + 1


def test_codes_in_the_source_are_on_the_page_and_the_other_way_round(generated: ModuleType) -> None:
    page = generated.errors_page()
    used = {Code[name].value for name in re.findall(r"\bCode\.([A-Z_]+)\b", sources())}
    listed = {line.split("`")[1] for line in page.splitlines() if line.startswith("| `")}
    assert listed == used
    for code in Code:
        assert code.cause
        assert code.cure
        assert not code.cure.endswith(".")


def test_exceptions_that_are_raised_are_on_the_page(generated: ModuleType) -> None:
    raised = {name for name in re.findall(r"\braise (\w+)\(", sources()) if hasattr(errors, name)}
    assert len(raised) > 10
    page = generated.errors_page()
    assert [name for name in sorted(raised) if f"reseau.core.errors.{name}`" not in page] == []
    assert set(errors.__all__) == {name for name in errors.__all__ if f"reseau.core.errors.{name}`" in page}
    for name in errors.__all__:
        own = vars(getattr(errors, name))
        assert own["cause"]
        assert own["cure"]
        assert f"| {own['cause']} | {own['cure']} |" in page
        assert not own["cure"].endswith(".")


def test_every_document_has_a_schema_file_and_a_row(generated: ModuleType) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    files, page = generated.schemas(), generated.documents_page()
    assert len(files) == len(documents())
    for name, text in files.items():
        jsonschema.Draft202012Validator.check_schema(json.loads(text))
        assert f"../../schemas/{name}" in page


def test_pages_of_commands_that_no_longer_exist_are_removed(generated: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "commands").mkdir()
    (tmp_path / "commands" / "gone.md").write_text("# reseau gone\n")
    generated.write_pages(tmp_path)
    assert not (tmp_path / "commands" / "gone.md").exists()
    assert (tmp_path / "commands" / "calibrate.md").exists()
