"""Pages of the reference that are generated from the program: commands, documents, errors.

`python docs/generated.py` writes them to `docs/reference/generated`; so does every build of the site.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from typer.main import get_command

from reseau.cli import app
from reseau.cli.program import documents
from reseau.core import errors
from reseau.core.failure import Code
from reseau.core.files import write_whole
from reseau.core.plugins import CAMERAS, DISCOVERY, INSTRUMENTS, SESSIONS, SIMULATORS
from reseau.core.vocabulary import names

__all__ = [
    "command_pages", "documents_page", "errors_page", "names_table", "plugins_page", "schemas", "write_pages",
]  # fmt: skip

FOLDER = Path(__file__).with_name("reference") / "generated"


def write_pages(folder: Path = FOLDER) -> None:
    """Write all pages; a page that did not change keeps its time, so that it is not built again."""
    pages = {f"commands/{name}": text for name, text in command_pages().items()}
    pages |= {"errors": errors_page(), "documents": documents_page(), "plugins": plugins_page()}
    pages["names"] = names_table()
    for stale in {*folder.rglob("*.md")} - {folder / f"{name}.md" for name in pages}:
        stale.unlink()
    for name, text in pages.items():
        path = folder / f"{name}.md"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text("utf-8") != text:
            write_whole(path, text)


def schemas() -> dict[str, str]:
    """The JSON Schema of every document, by the name of its file."""
    return {
        f"{name.replace('/', '-')}.json": json.dumps(kind.json_schema(), indent=1, ensure_ascii=False) + "\n"
        for name, kind in documents().items()
    }


def command_pages() -> dict[str, str]:
    """A page for each command of the first level, with all below it, and their index."""
    root: Any = get_command(app)
    pages, rows = {}, []
    for name, command in sorted(root.commands.items()):
        parts = [_command(each, words) for words, each in _walk(command, ["reseau", name])]
        pages[name] = "\n".join(parts)
        rows.append(f"| [`reseau {name}`]({name}.md) | {_line(command.help)} |")
    index = ["# Commands", "", "Generated from the program; `--help` of a command prints the same.", ""]
    index += ["| command | |", "|---|---|", *rows, "", "```{toctree}", ":hidden:", "", *pages, "```", ""]
    return pages | {"index": "\n".join(index)}


def names_table() -> str:
    """The vocabulary as a table: names in Python, files and commands, their values and meanings."""
    root: Any = get_command(app)
    used: dict[str, list[str]] = {}
    for words, command in _walk(root, []):
        for parameter in command.params:
            used.setdefault(str(parameter.name).rstrip("_"), []).append(" ".join(words))
    lines = ["| name | in commands | value | meaning | commands |", "|---|---|---|---|---|"]
    for name, declared in sorted(names().items()):
        option = declared.option
        flag = f"`--{(option.called or name).replace('_', '-')}`"
        value = option.value or ", ".join(declared.choices) or _KINDS.get(declared.type, "")
        limits = [f"≥ {option.least:g}"] if option.least is not None else []
        limits += [f"≤ {option.most:g}"] if option.most is not None else []
        where = used.get(name, [])
        lines.append(
            f"| `{name}` | {flag}{f', `{option.letter}`' if option.letter else ''} "
            f"| {_line(' '.join([value, *limits]))} | {_line(declared.help)} "
            f"| {', '.join(where) if len(where) < 4 else len(where)} |"
        )
    return "\n".join([*lines, ""])


_KINDS = {int: "integer", float: "number", str: "text", Path: "path", bool: "switch"}


def _walk(command: Any, words: list[str]) -> Iterator[tuple[list[str], Any]]:
    yield words, command
    for name, below in sorted(getattr(command, "commands", {}).items()):
        yield from _walk(below, [*words, name])


def _command(command: Any, words: list[str]) -> str:
    """Section of a command: usage, help, arguments and options."""
    context = command.context_class(command, info_name=" ".join(words))
    usage = " ".join([*words, *command.collect_usage_pieces(context)])
    lines = [f"{'#' * min(len(words) - 1, 3)} {' '.join(words)}", "", "```sh", usage, "```", ""]
    lines += [_text(command.help), ""]
    rows = []
    for parameter in command.params:
        if getattr(parameter, "hidden", False) or parameter.name == "help":
            continue
        record = parameter.get_help_record(context)
        name, text = record if record else (parameter.human_readable_name, getattr(parameter, "help", ""))
        shown = name.replace("|", r"\|")
        rows.append(f"| `{shown}` | {_line(text)} |")
    if rows:
        lines += ["| argument or option | |", "|---|---|", *rows, ""]
    return "\n".join(lines)


def _text(given: str | None) -> str:
    """Help as Markdown: paragraphs; what begins with a dash is a list."""
    return inspect.cleandoc(given or "").replace("\b\n", "").replace("<", r"\<")


def _line(given: str | None) -> str:
    """Help as one cell of a table."""
    text = " ".join(_text(given).split())
    return re.sub(r"(?<!\\)\|", r"\\|", text).replace("[", r"\[")


def errors_page() -> str:
    """Exceptions with their exit status, and codes with cause and cure."""
    kinds = [
        kind
        for kind in vars(errors).values()
        if isinstance(kind, type) and issubclass(kind, errors.ReseauError)
    ]
    lines = [
        "# Errors and warnings",
        "",
        "Every message is one line: where, what is wrong, what to do. A command ends with the "
        "exit status 0 when it succeeded, 1 when there is no result, 2 when an argument or a file "
        "cannot be used, and 3 when everything was written, but the result contradicts itself: "
        "observations contradict each other for a reason other than chance, or a value cannot be. "
        "The reason is said first; `status` of documents and results is then `contradictory`.",
        "",
        "## Codes",
        "",
        "A failed estimate, a mark that was declined and a warning carry a code beside their "
        "message. It is in the documents and in the output of `--json`, stays the same when a "
        "message is rephrased, and is the {py:class}`~reseau.core.failure.Code` of "
        "{py:class}`~reseau.core.failure.Failure` in Python.",
        "",
        "| code | cause | cure |",
        "|---|---|---|",
        *(f"| `{code.value}` | {code.cause} | {code.cure} |" for code in Code),
        "",
        "## Exceptions",
        "",
        "Misuse, files and instruments raise an exception. Its message says what to do; on the "
        "command line it is printed, and the exit status is that of the table.",
        "",
        "| exception | is a | meaning | cause | cure | exit status |",
        "|---|---|---|---|---|---|",
    ]
    for kind in kinds:
        base = kind.__base__.__name__ if kind.__base__ is not None else ""
        about = (inspect.getdoc(kind) or "").splitlines()[0]
        shown = f"{{py:class}}`~reseau.core.errors.{kind.__name__}`"
        lines.append(f"| {shown} | {base} | {about} | {kind.cause} | {kind.cure} | {kind.exit_status} |")
    return "\n".join([*lines, ""])


def documents_page() -> str:
    """Every kind of document with the file of its JSON Schema."""
    lines = [
        "# Schemas of all documents",
        "",
        "Generated from the models that read and write the files; `reseau schema NAME` prints the "
        "same. What the keys mean is in [file formats](../../formats/index.md).",
        "",
        "| schema | JSON Schema | |",
        "|---|---|---|",
    ]
    for name, kind in documents().items():
        about = (inspect.getdoc(kind) or "").splitlines()[0].replace(f"``{name}``: ", "").replace("``", "`")
        file = f"{name.replace('/', '-')}.json"
        link = f'<a href="../../schemas/{file}">{file}</a>'
        lines.append(f"| `{name}` | {link} | {about[:1].upper()}{about[1:]} |")
    return "\n".join([*lines, ""])


def plugins_page() -> str:
    """Entry points: the groups, and what the project itself puts in them."""
    about = {
        INSTRUMENTS: "drivers: called with name, address, `settings`, `limits` and `options` of `bench.toml`",
        DISCOVERY: "functions without arguments that return addresses of instruments that were found",
        SIMULATORS: "simulated benches: `reseau bench sim`",
        CAMERAS: "camera models: objects of the class `CameraModel`",
        SESSIONS: "kinds of sessions: objects of the class `SessionKind`",
    }
    lines = [
        "# Entry points",
        "",
        "A package adds instruments, camera models and kinds of sessions by [entry "
        "points](https://packaging.python.org/specifications/entry-points/) in its "
        "`pyproject.toml`; nothing of the project is changed. How to write one: "
        "[extend the project](../../contributing/extend.md).",
    ]
    for group, text in about.items():
        lines += ["", f"## {group}", "", f"{text[:1].upper()}{text[1:]}."]
        found = sorted((each.name, each.value) for each in entry_points(group=group))
        rows = [f"| `{name}` | `{value}` |" for name, value in found if value.startswith("reseau")]
        lines += ["", "| name | object |", "|---|---|", *rows] if rows else []
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    write_pages()
    print(FOLDER)
