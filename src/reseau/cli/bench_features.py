"""`reseau bench features`: browse, search and set features of a GenICam camera; compare user sets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from .bench_by_hand import held_one
from .common import say


def features(
    search: Annotated[
        str, typer.Argument(help="Text in name, category, unit, values or description. Default: all.")
    ] = "",
    bench: v.Bench = Path("bench.toml"),
    camera: v.Camera | None = None,
    set_: Annotated[v.Set | None, "Here a feature, within its range."] = None,
    save: Annotated[str, typer.Option("--save-set", help="Keep the present values in this user set.")] = "",
    compare: Annotated[
        str,
        typer.Option("--compare", help="User sets to compare, as UserSet1,UserSet2; one: with the present."),
    ] = "",
    as_json: v.AsJson = False,
) -> None:
    """List features of a GenICam camera with values, ranges and units; set them; save and compare user sets.

    What is set stays until the camera is switched off or opened with other settings: keep it in a user set,
    or in the bench file with `reseau bench set camera features=...`.
    """
    from ..core.provenance import canonical_json
    from ..instruments import Camera

    wanted = dict(_pair(text) for text in set_ or [])
    with held_one(bench, Camera, camera, "reseau bench features") as found:
        if not hasattr(found, "user_sets"):
            raise UsageError("has no GenICam features", where=found.name)
        if wanted:
            found.set_features(wanted)
        if save:
            found.save_user_set(save)
        if compare:
            _compare(found, [each.strip() for each in compare.split(",")], as_json)
            return
        listed = found.features(search)
        if wanted and not search:
            listed = [each for each in listed if each.name in wanted]
    if as_json:
        rows = [
            {key: value for key, value in vars(each).items() if value not in (None, "", ())}
            for each in listed
        ]
        say(canonical_json({"schema": "reseau-features/1", "features": rows}))
        return
    category = ""
    for each in listed:
        if each.category != category:
            category = each.category
            say(f"{category}\n")
        say(f"  {each}\n")
    if not listed:
        say(f"no feature with {search!r}\n")


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier() or not value:
        raise UsageError(f"cannot interpret {text!r}", where="--set", do="write Name=value")
    return name, value


def _compare(camera: Any, names: list[str], as_json: bool) -> None:
    """Print the features that differ between two user sets, or between one and the present values."""
    from ..core.provenance import canonical_json

    if len(names) > 2 or not all(names):
        raise UsageError("takes one or two user sets", where="--compare", do="write UserSet1,UserSet2")
    different = camera.compare_user_sets(*names)
    names = [*names, "present"][:2]
    if as_json:
        say(canonical_json({"schema": "reseau-user-sets/1", "sets": names, "different": different}))
        return
    say(
        "".join(f"{key}: {one} in {names[0]}, {two} in {names[1]}\n" for key, (one, two) in different.items())
    )
    if not different:
        say(f"{names[0]} and {names[1]} do not differ\n")
