"""`reseau bundle`: adjust a network of images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .bundle_options import (
    Alpha,
    ComponentsOf,
    Distances,
    Eliminate,
    Reject,
    component_kind,
    level_of,
    outputs,
    positive,
    say_left_out,
    say_model,
    say_parameters,
    say_refraction,
)
from .common import AsJson, Out, progress, required, say

if TYPE_CHECKING:
    from ..bundle import Result

__all__ = ["bundle"]


def bundle(
    network: Annotated[
        Path,
        typer.Argument(
            help="Network: reseau-network/1, a file of PhotoModeler or BAL, or a folder of COLMAP."
        ),
    ],
    out: Out = None,
    reject: Reject = False,
    alpha: Alpha = 0.001,
    components: ComponentsOf = None,
    eliminate: Eliminate = None,
    cov: Annotated[
        bool, typer.Option("--cov", help="Include full covariances of the points in the result.")
    ] = False,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            help="Calibration of a camera of the network, or orientation of its film frame, "
            "as ID=calibration.json; repeatable."
        ),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Report to write, HTML.")] = None,
    distance: Distances = None,
    as_json: AsJson = False,
) -> None:
    """Adjust a network of images: orientation, calibration and object points, with their uncertainty."""
    from ..bundle import Options, ResultDocument, search_model
    from ..core.provenance import Provenance, sha256_of
    from ..exchange import read_network
    from ..io import write_whole

    level_of(alpha, "--alpha")
    outputs(out, report)
    distance = positive(distance)
    calibrations = _calibrations(camera or [])
    content = read_network(network, calibrations)
    with progress("adjusting", 30) as step:
        options = Options(
            outliers="reject" if reject else "keep", alpha=alpha, watch=lambda k, cost: step(f"iteration {k}")
        )
        found = search_model(content, options, component_kind(components), level_of(eliminate, "--eliminate"))
        result = required(found, network)
    settings = {"reject": reject, "alpha": alpha, "components": component_kind(components),
                "eliminate": eliminate}  # fmt: skip
    hashes = {file.name: sha256_of(file) for file in calibrations.values()}
    provenance = Provenance(_hashes(network) | hashes, settings)
    document = ResultDocument.of(result, covariances=cov, provenance=provenance)
    if report is not None:
        from ..report.bundle import bundle_report

        page = bundle_report(result, title=network.name, provenance=provenance, distances=distance or ())
        write_whole(report, page)
    if out is not None:
        document.write(out)
    if as_json:
        say(document.to_json())
    else:
        _say(network, result)


def _hashes(path: Path) -> dict[str, str]:
    """SHA-256 of a network file and its calibrations, or of the text files in a folder."""
    from ..core.provenance import sha256_of
    from ..exchange import calibration_files

    if path.is_file():
        files = [path, *calibration_files(path)]
        return {file.name: sha256_of(file) for file in files}
    return {f"{path.name}/{file.name}": sha256_of(file) for file in sorted(path.glob("*.txt"))}


def _calibrations(texts: list[str]) -> dict[str, Path]:
    """Calibration files by camera, from options ``ID=file``."""
    from ..core.errors import UsageError

    found: dict[str, Path] = {}
    for text in texts:
        name, equals, file = text.partition("=")
        if not equals or not name or not file or name in found:
            raise UsageError(f"is {text!r}", where="--camera", do="write ID=calibration.json, each ID once")
        found[name] = Path(file)
    return found


def _say(path: Path, result: Result) -> None:
    observations, unknowns, constraints = result.fit.counts
    left_out = f", {int(result.rejected.sum())} image points left out" if result.rejected.any() else ""
    say(
        f"{path.name}: {observations} observations, {unknowns} unknowns, {constraints} constraints, "
        f"redundancy {result.redundancy}\n"
        f"sigma0 {result.sigma0:.4g} after {result.fit.iterations} iterations{left_out}\n"
    )
    for camera in result.cameras.values():
        if camera.parameters:
            say(f"camera {camera.id}\n")
            say_parameters(camera)
    if result.refraction is not None:
        say("windows and media\n")
        say_refraction(result.refraction)
    say_model(result)
    say_left_out(result)
    for warning in result.warnings:
        say(f"warning: {warning}\n")
