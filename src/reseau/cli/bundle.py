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
)
from .common import AsJson, Out, progress, required, say

if TYPE_CHECKING:
    from ..bundle import Network, Searched

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
    cov: Annotated[bool, typer.Option("--cov", help="Full covariances of the points in the result.")] = False,
    report: Annotated[Path | None, typer.Option(help="Report to write, HTML.")] = None,
    distance: Distances = None,
    as_json: AsJson = False,
) -> None:
    """Adjust a bundle: orientation, calibration and points from image coordinates, with all their quality."""
    from ..bundle import Options, search_model, searched_document, to_document
    from ..core.provenance import Provenance, canonical_json, sha256_of
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
        searched = required(found, network)
    document = to_document(searched.result, covariances=cov) | searched_document(searched)
    if report is not None:
        from ..report.bundle import bundle_report

        inputs = {network.name: sha256_of(network)} if network.is_file() else {}
        settings = {"reject": reject, "alpha": alpha, "components": component_kind(components),
                    "eliminate": eliminate}  # fmt: skip
        page = bundle_report(
            searched, title=network.name, provenance=Provenance(inputs, settings), distances=distance or ()
        )
        write_whole(report, page)
    if out is not None:
        write_whole(out, canonical_json(document))
    if as_json:
        say(canonical_json(document))
    else:
        _say(network, searched)


def read_network(path: Path) -> Network:
    """A network from a file of ours, or of another program, told apart by what is in it."""
    from ..bundle import Network
    from ..exchange import read_foreign
    from ..io.network import Network1

    if path.is_dir() or path.suffix.lower() != ".json":
        return read_foreign(path)
    return Network.from_document(Network1.read(path))


def _say(path: Path, searched: Searched) -> None:
    result = searched.result
    observations, unknowns, constraints = result.fit.counts
    say(
        f"{path.name}: {observations} observations, {unknowns} unknowns, {constraints} constraints, "
        f"redundancy {result.redundancy}\n"
        f"sigma0 {result.sigma0:.6g} after {result.fit.iterations} iterations"
        f"{f', {int(result.rejected.sum())} image points left out' if result.rejected.any() else ''}\n"
    )
    for c, camera in enumerate(result.network.cameras):
        names, _, values = result.camera_columns(c)
        if not names:
            continue
        say(f"camera {camera.id}\n")
        sigma = result.camera_covariance(c).diagonal() ** 0.5
        for name, value, s in zip(names, values, sigma, strict=True):
            say(f"  {name:<6} {value:14.7g} ± {s:.3g}\n")
    say_model(searched)
    say_left_out(result)
    for warning in result.warnings:
        say(f"warning: {warning}\n")
