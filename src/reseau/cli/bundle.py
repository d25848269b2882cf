"""`reseau bundle`: the adjustment of a network of images."""

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
)
from .common import AsJson, Out, progress, required, say

if TYPE_CHECKING:
    from ..bundle import Network, Result

__all__ = ["bundle", "read_network"]


def bundle(
    network: Annotated[
        Path, typer.Argument(help="Network: reseau-network/1, or a file of PhotoModeler, BAL or COLMAP.")
    ],
    out: Out = None,
    reject: Reject = False,
    alpha: Alpha = 0.001,
    components: ComponentsOf = None,
    eliminate: Eliminate = None,
    cov: Annotated[
        bool, typer.Option("--cov", help="Include full covariances of the points in the result.")
    ] = False,
    report: Annotated[Path | None, typer.Option(help="Report to write, HTML.")] = None,
    distance: Distances = None,
    as_json: AsJson = False,
) -> None:
    """Adjust a network of images: orientation, calibration and object points, with their quality."""
    from ..bundle import Options, ResultDocument, search_model
    from ..core.provenance import Provenance
    from ..io import write_whole

    level_of(alpha, "--alpha")
    outputs(out, report)
    distance = positive(distance)
    content = read_network(network)
    with progress("adjusting", 30) as step:
        options = Options(
            outliers="reject" if reject else "keep", alpha=alpha, watch=lambda k, cost: step(f"iteration {k}")
        )
        found = search_model(content, options, component_kind(components), level_of(eliminate, "--eliminate"))
        result = required(found, network)
    settings = {"reject": reject, "alpha": alpha, "components": component_kind(components),
                "eliminate": eliminate}  # fmt: skip
    provenance = Provenance(_hashes(network), settings)
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
    """SHA-256 of a file, or of the text files in a folder."""
    from ..core.provenance import sha256_of

    if path.is_file():
        return {path.name: sha256_of(path)}
    return {f"{path.name}/{file.name}": sha256_of(file) for file in sorted(path.glob("*.txt"))}


def read_network(path: Path) -> Network:
    """A network from a file of ours, or of another program, told apart by what is in it."""
    from ..bundle import Network
    from ..exchange import read_foreign
    from ..io.network import Network1

    if path.is_dir() or path.suffix.lower() != ".json":
        return read_foreign(path)
    return Network.from_document(Network1.read(path))


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
    say_model(result)
    say_left_out(result)
    for warning in result.warnings:
        say(f"warning: {warning}\n")
