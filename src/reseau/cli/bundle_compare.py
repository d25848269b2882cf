"""`reseau compare`: map the difference of two calibrations of a camera over the image."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.files import writable
from ..core.options import Option
from .bundle_options import say_difference
from .common import say

if TYPE_CHECKING:
    from ..calibration import CameraMapping, FieldDifference


SCHEMA = "reseau-difference/1"


def compare(
    first: Annotated[Path, typer.Argument(help="Calibration of a camera, reseau-calibration/1.")],
    second: Annotated[Path, typer.Argument(help="Another calibration of the same camera.")],
    out: v.Out | None = None,
    figure: Annotated[v.Figure | None, "Here a map of the difference, SVG."] = None,
    places: Annotated[int, Option("Number of positions across the image.", least=2)] = 25,
    as_json: v.AsJson = False,
) -> None:
    """Compare two calibrations of a camera: map their difference over the image and test its significance."""
    from ..calibration import calibration_difference
    from ..core.provenance import canonical_json
    from ..io import write_whole

    writable(out, ".json")
    writable(figure, ".svg")
    found = calibration_difference(read_lens(first), read_lens(second), places)
    document = canonical_json(_document(first, second, found))
    if figure is not None:
        from ..report.fields import difference_figure

        write_whole(figure, difference_figure(found))
    if out is not None:
        write_whole(out, document)
    if as_json:
        say(document)
    else:
        say_difference(second.name, found)


def read_lens(path: Path) -> CameraMapping:
    """Read the camera mapping of a calibration file."""
    from ..calibration import CameraMapping, read_calibration

    return CameraMapping.from_calibration(read_calibration(path))


def _document(first: Path, second: Path, found: FieldDifference) -> dict[str, Any]:
    """The difference in rows of the image; null where a camera images no ray."""
    from ..core.data import sigmas_of
    from ..core.numbers import or_null
    from ..core.provenance import sha256_of

    def rows(values: Any) -> list[list[float | None]]:
        return [[or_null(v) for v in row] for row in values]

    return {
        "schema": SCHEMA,
        "inputs": {path.name: sha256_of(path) for path in (first, second)},
        "unit": "px",
        "statistic": found.statistic,
        "degrees": found.degrees,
        "p": found.p,
        "p_alone": found.p_alone,
        "rotation_rad": found.rotation.tolist(),
        "x": found.xy[0, :, 0].tolist(),
        "y": found.xy[:, 0, 1].tolist(),
        "dx": rows(found.difference[..., 0]),
        "dy": rows(found.difference[..., 1]),
        **dict(zip(("sx", "sy", "rho"), map(rows, sigmas_of(found.cov)), strict=True)),
        "p_at": rows(found.p_at),
    }
