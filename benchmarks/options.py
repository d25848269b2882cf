"""Commands, options and names of the command line, and the lines that it takes.

Run from the checkout: ``python benchmarks/options.py``. A name has several meanings if its type, or the first
sentence of its help, is not the same in all commands.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from typer.main import get_command

import reseau.cli


def commands(command: Any) -> Iterator[Any]:
    """Every command."""
    below = getattr(command, "commands", None)
    if below is None:
        yield command
    for each in (below or {}).values():
        yield from commands(each)


def main() -> None:
    """Print the counts."""
    meanings, counted, options = defaultdict[str, set[tuple[str, str]]](set), 0, 0
    for command in commands(get_command(reseau.cli.app)):
        counted += 1
        for each in command.params:
            if each.param_type_name == "option":
                options += 1
                name = next(word for word in each.opts if word.startswith("--"))
                kind = each.bare_type().removeprefix("list[").removesuffix("]")
                meanings[name].add((kind, (each.help or "").split(". ")[0].rstrip(".")))
    several = sorted(name for name, each in meanings.items() if len(each) > 1)
    lines = sum(
        len(path.read_text("utf-8").splitlines()) for path in Path(reseau.cli.__file__).parent.glob("*.py")
    )
    print(f"{counted} commands, {options} options, {len(meanings)} names, {lines} lines")
    print(f"{len(several)} names with several meanings: {' '.join(several)}")


if __name__ == "__main__":
    main()
