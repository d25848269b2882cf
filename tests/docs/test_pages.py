"""The pages: links lead somewhere, commands and options exist, lines of Python run, no how-to is long."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from reseau.cli import app

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(
    page
    for page in (*ROOT.glob("*.md"), *DOCS.rglob("*.md"))
    if not {"generated", "_templates"} & set(page.parts)
)
TWO_SCREENS = 80
"""Lines of a how-to page."""

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())


def prose(page: Path) -> str:
    """The page without its blocks of code."""
    return re.sub(r"^ *(`{3,})(?!\{).*?^ *\1$", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub and MyST form it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@cache
def anchors(page: Path) -> frozenset[str]:
    headings = re.findall(r"^#+ +(.*)$", prose(page), re.MULTILINE)
    targets = re.findall(r"^\(([\w-]+)\)=$", prose(page), re.MULTILINE)
    return frozenset(map(slug, headings)) | frozenset(targets)


@pages
def test_links_lead_to_files_and_headings_that_exist(page: Path) -> None:
    wrong = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        generated = target.is_relative_to(DOCS) and "generated" in target.parts
        found = generated or (target.exists() and target.is_relative_to(ROOT))
        if found and anchor and target.suffix == ".md":
            found = anchor in anchors(target)
        if not found:
            wrong.append(link)
    assert wrong == []


@pytest.mark.parametrize("tree", ["src", "drivers", "sims", "benchmarks"])
def test_pages_that_the_program_names_exist(tree: str) -> None:
    named = {
        (name, source.relative_to(ROOT).as_posix())
        for source in (ROOT / tree).rglob("*.py")
        for name in re.findall(r"\bdocs/[\w/-]+\.md\b", source.read_text("utf-8"))
    }
    assert [each for each in sorted(named) if not (ROOT / each[0]).exists()] == []


def printed(page: Path) -> Iterator[list[str]]:
    """Every command that the page prints, in a block or in a line, as words."""
    text = page.read_text("utf-8")
    blocks = re.findall(r"^```(?:sh|console)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    blocks += re.findall(r"(?:^    (?:reseau|\.\.\.) .*\n)+", text, re.MULTILINE)
    lines = [
        line.strip().removeprefix("$ ")
        for block in blocks
        for line in re.sub(r"\\\n\s*", " ", block).splitlines()
    ]
    lines += [re.sub(r"\s+", " ", inline) for inline in re.findall(r"`(reseau [^`]*)`", prose(page))]
    for line in lines:
        if line.startswith("reseau "):
            yield shlex.split(line.replace("…", "x"), comments=True)


@cache
def commands() -> Any:
    return get_command(app)


def refusal(words: list[str]) -> str:
    """Why the program would not accept a command, apart from its values; empty if it would."""
    command: Any = commands()
    words = [word for word in words[1:] if word != "&"]
    while hasattr(command, "commands"):
        if not words or words[0] in {"--help", "x"} or words[0].isupper():
            return ""
        if words[0].startswith("-"):
            break
        if words[0] not in command.commands:
            return f"no command {words[0]!r}"
        command, words = command.commands[words[0]], words[1:]
    context = command.context_class(command, info_name=command.name)
    try:
        # Values are not converted: the files of an example need not exist. A mention may end with an option.
        command.make_parser(context).parse_args([word for word in words if word != "--help"] + ["x", "x"])
    except Exception as error:
        return str(getattr(error, "message", error))
    return ""


@pages
def test_commands_and_options_that_a_page_prints_exist(page: Path) -> None:
    if page.name == "CHANGELOG.md":  # commands as they were called at the time
        return
    wrong = [(shlex.join(words), why) for words in printed(page) if (why := refusal(words))]
    assert wrong == []


def test_a_command_or_an_option_that_does_not_exist_is_seen() -> None:
    assert "no command" in refusal(["reseau", "calibrat", "photos"])
    assert "No such option" in refusal(["reseau", "measure", "reseau", "a.png", "--desing", "d.json"])
    assert refusal(["reseau", "measure", "reseau", "a.png", "--design", "d.json"]) == ""


@pytest.mark.parametrize("page", sorted((DOCS / "howto").glob("*.md")), ids=lambda page: page.stem)
def test_a_how_to_is_one_task_on_at_most_two_screens_with_a_picture_and_the_next_step(page: Path) -> None:
    text = page.read_text("utf-8")
    assert len(re.findall(r"^# ", prose(page), re.MULTILINE)) == 1
    if page.stem != "index":
        assert len(text.splitlines()) <= TWO_SCREENS
        assert re.search(r"^!\[", text, re.MULTILINE)
        assert re.search(r"Next:\s+\[", text)
        assert re.search(rf"^{page.stem}$", (DOCS / "howto" / "index.md").read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize(
    "page",
    [
        page
        for page in (
            DOCS / "conventions.md",
            *sorted(DOCS.glob("howto/*.md")),
            *sorted(DOCS.glob("concepts/*.md")),
        )
        if "```python" in page.read_text("utf-8")
    ],
    ids=lambda page: page.stem,
)
def test_lines_of_python_run_in_the_order_of_the_page_and_print_what_it_shows(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    blocks = re.findall(r"^```python\n(.*?)^```$", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    for number, block in enumerate(blocks):
        if block.startswith(">>>"):
            shown = doctest.DocTestParser().get_doctest(block, names, f"{page.name}[{number}]", str(page), 0)
            runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS, verbose=False)
            said: list[str] = []
            runner.run(shown, out=said.append, clear_globs=False)
            assert not runner.failures, "".join(said)
            names = shown.globs
        else:
            exec(compile(block, str(page), "exec"), names)


MATHEMATICS = sorted(page for page in (DOCS / "mathematics").glob("*.md") if page.stem != "index")


@pytest.mark.parametrize("page", MATHEMATICS, ids=lambda page: page.stem)
def test_a_page_of_mathematics_names_what_computes_it_and_is_named_by_it(page: Path) -> None:
    named = re.findall(r"\{py:(func|class)\}`([\w.]+) <([\w.]+)>`", page.read_text("utf-8"))
    assert named
    back = []
    for role, public, defined in named:
        package, _, name = public.rpartition(".")
        each = getattr(importlib.import_module(package), name)
        assert f"{each.__module__}.{each.__qualname__}" == defined
        assert inspect.isclass(each) == (role == "class")
        back.append(f"``docs/mathematics/{page.name}``" in (inspect.getdoc(each) or ""))
    assert any(back)
