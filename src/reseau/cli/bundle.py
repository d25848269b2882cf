"""`reseau bundle`: the adjustment of a network of images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .common import AsJson, Out, progress, required, say, suffix_of, writable

if TYPE_CHECKING:
    from ..bundle import Network, Result

__all__ = ["bundle", "read_network"]


def bundle(
    network: Annotated[
        Path, typer.Argument(help="Network: reseau-network/1, or a file of PhotoModeler, BAL or COLMAP.")
    ],
    out: Out = None,
    reject: Annotated[bool, typer.Option("--reject", help="Leave blunders out, by data snooping.")] = False,
    alpha: Annotated[float, typer.Option(help="Level of the single test of data snooping.")] = 0.001,
    cov: Annotated[bool, typer.Option("--cov", help="Full covariances of the points in the result.")] = False,
    report: Annotated[Path | None, typer.Option(help="Report to write, HTML.")] = None,
    as_json: AsJson = False,
) -> None:
    """Adjust a bundle: orientation, calibration and points from image coordinates, with all their quality."""
    from ..bundle import Options, adjust_network, to_document
    from ..errors import UsageError
    from ..formats import write_whole
    from ..provenance import Provenance, canonical_json, sha256_of

    if not 0 < alpha < 1:
        raise UsageError(f"{alpha:g} is not between 0 and 1", where="--alpha")
    for path, suffixes in ((out, (".json",)), (report, (".html",))):
        if path is not None:
            suffix_of(writable(path), suffixes)
    content = read_network(network)
    with progress("adjusting", 30) as step:
        options = Options(
            outliers="reject" if reject else "keep", alpha=alpha, watch=lambda k, cost: step(f"iteration {k}")
        )
        result = required(adjust_network(content, options), network)
    document = to_document(result, covariances=cov)
    if report is not None:
        from ..report.bundle import bundle_report

        inputs = {network.name: sha256_of(network)} if network.is_file() else {}
        provenance = Provenance(inputs, {"reject": reject, "alpha": alpha})
        write_whole(report, bundle_report(result, title=network.name, provenance=provenance))
    if out is not None:
        write_whole(out, canonical_json(document))
    if as_json:
        say(canonical_json(document))
    else:
        _say(network, result)


def read_network(path: Path) -> Network:
    """A network from a file of ours, or of another program, told apart by what is in it."""
    from ..bundle import Network
    from ..exchange import read_foreign
    from ..formats.network import Network1

    if path.is_dir() or path.suffix.lower() != ".json":
        return read_foreign(path)
    return Network.from_document(Network1.read(path))


def _say(path: Path, result: Result) -> None:
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
    for image, point in zip(*result.rejected_names(), strict=True):
        say(f"left out: point {point} in image {image}\n")
    for warning in result.warnings:
        say(f"warning: {warning}\n")
