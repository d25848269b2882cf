"""`reseau bundle`: adjust a network of images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ..core import vocabulary as v
from ..core.files import writable
from ..core.options import Group, Option
from .bundle_options import (
    level_of,
    positive,
    say_estimated,
    say_left_out,
    say_model,
    say_parameters,
    say_priors,
)
from .common import ended, pairs_of, progress, required, say, say_notes

if TYPE_CHECKING:
    from ..bundle import Network, Result
    from ..bundle.network.network import Datum


# Settings that the provenance always has.
_ALWAYS = ("reject", "alpha", "components", "eliminate")


def bundle(
    network: Annotated[
        Path,
        typer.Argument(
            help="Network: reseau-network/1, a file of PhotoModeler, Metashape, BAL, Bundler or libmv, "
            "or a folder of COLMAP, OpenPTV, MicMac or MMVII."
        ),
    ],
    out: v.Out | None = None,
    camera_calibration: Annotated[
        list[str] | None,
        Option(
            "Calibration of a camera of the network, or orientation of its film frame; repeatable.",
            Group.CAMERA,
            value="ID=FILE",
        ),
    ] = None,
    free: Annotated[v.Free, "ID:K1 for one camera; all."] = (),
    fix: Annotated[
        tuple[str, ...],
        Option("Parameters to hold at their given values; as --free.", Group.CAMERA, value="c,x0,y0,K1"),
    ] = (),
    control: Annotated[v.Control | None, "Held without sigmas, otherwise observed."] = None,
    datum: Annotated[
        Literal["control", "minimal", "free"] | None,
        Option("What defines position, orientation and scale.", Group.ADJUSTMENT),
    ] = None,
    sigma_px: v.SigmaPx | None = None,
    control_sigma: v.ControlSigma | None = None,
    sensor_width: v.SensorWidth | None = None,
    reject: v.Reject = False,
    alpha: Annotated[v.Alpha, "Here of data snooping."] = 0.001,
    components: v.Components | None = None,
    eliminate: v.Eliminate | None = None,
    distance: v.Distance | None = None,
    cov: Annotated[
        bool,
        Option("Include full covariances of the points in the result.", Group.FILES),
    ] = False,
    convert: Annotated[
        Path | None,
        Option("Write the network as reseau-network/1 with these settings; nothing is adjusted."),
    ] = None,
    export: Annotated[
        Path | None,
        Option("Write the adjusted network: .json (reseau-network/1), .bal, or a folder for COLMAP."),
    ] = None,
    report: v.Report | None = None,
    memory_gb: v.MemoryGb | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Adjust a network of images: orientation, calibration and object points, with their uncertainty."""
    from ..bundle import Options, ResultDocument, search_model
    from ..bundle.network.settings import network_document
    from ..core.provenance import Provenance, sha256_of
    from ..exchange import read_network
    from ..io import write_whole

    level_of(alpha, "--alpha")
    writable(out, ".json")
    writable(report, ".html")
    writable(convert, ".json")
    distance = positive(distance)
    given = pairs_of(camera_calibration, "--camera-calibration", "ID=calibration.json, each ID once")
    calibrations = {name: Path(file) for name, file in given.items()}
    read = read_network(network, calibrations, control_sigma=control_sigma, sensor_width=sensor_width)
    say_notes(read.notes)
    content = _with_settings(read, free, fix, control, datum, sigma_px)
    if convert is not None:
        network_document(content).write(convert)
        return
    with progress("adjusting", 30) as step:
        options = Options(
            outliers="reject" if reject else "keep", alpha=alpha, memory_gb=memory_gb,
            watch=lambda k, cost: step(f"iteration {k}"),
        )  # fmt: skip
        found = search_model(content, options, components, level_of(eliminate, "--eliminate"))
        result = required(found, network)
    settings = {"reject": reject, "alpha": alpha, "components": components,
                "eliminate": eliminate, "free": free, "fix": fix, "datum": datum,
                "sigma_px": sigma_px, "control_sigma": control_sigma, "sensor_width": sensor_width,
                "memory_gb": memory_gb}  # fmt: skip
    settings = {key: value for key, value in settings.items() if key in _ALWAYS or value not in (None, ())}
    more = [*calibrations.values(), *([] if control is None else [control])]
    hashes = {file.name: sha256_of(file) for file in more}
    provenance = Provenance(_hashes(network) | hashes, settings)
    document = ResultDocument.of(result, covariances=cov, provenance=provenance)
    if report is not None:
        from ..report.bundle import bundle_report

        page = bundle_report(result, title=network.name, provenance=provenance, distances=distance or ())
        write_whole(report, page)
    if out is not None:
        document.write(out)
    if export is not None:
        _export(result, export)
    if as_json:
        say(document.to_json())
    else:
        _say(network, result)
    ended(result.status)


def _export(result: Result, path: Path) -> None:
    """Write the adjusted network, and say where cameras had to be converted."""
    from ..exchange.networks import write_network

    for name, done in write_network(result, path).items():
        if done.greatest_px > 0:
            say_notes([f"camera {name} as {done.camera.model} differs by {done.greatest_px:.2g} px at most"])


def _with_settings(
    network: Network,
    free: Sequence[str],
    fix: Sequence[str],
    control: Path | None,
    datum: Datum | None,
    sigma_px: float | None,
) -> Network:
    """Return the network with what the user sets."""
    from ..bundle.network.settings import with_control, with_datum, with_parameters, with_sigma
    from ..core.errors import UsageError
    from ..exchange.tables import read_control

    network = with_parameters(network, free, fix)
    if control is not None:
        if datum not in (None, "control"):
            raise UsageError("cannot be combined with --control", where=f"--datum {datum}")
        network = with_control(network, read_control(control))
    if datum is not None:
        network = with_datum(network, datum)
    return network if sigma_px is None else with_sigma(network, sigma_px)


def _hashes(path: Path) -> dict[str, str]:
    """SHA-256 of a network file and its calibrations, or of the text files in a folder."""
    from ..core.provenance import sha256_of
    from ..exchange.networks import calibration_files

    if path.is_file():
        files = [path, *calibration_files(path)]
        return {file.name: sha256_of(file) for file in files}
    return {f"{path.name}/{file.name}": sha256_of(file) for file in sorted(path.glob("*.txt"))}


def _say(path: Path, result: Result) -> None:
    observations, unknowns, constraints = result.fit.counts
    left_out = f", {int(result.rejected.sum())} image points left out" if result.rejected.any() else ""
    say(
        f"{path.name}: {observations} observations, {unknowns} unknowns, {constraints} constraints, "
        f"redundancy {result.redundancy}\n"
        f"sigma0 {result.sigma0:.4g} after {result.fit.iterations} iterations{left_out}\n"
    )
    if result.contradiction is not None:
        say(f"contradictory: {result.contradiction}\n")
    for c, camera in enumerate(result.cameras.values()):
        if camera.parameters:
            say(f"camera {camera.id}\n")
            say_parameters(camera)
            say_priors(result.priors(c))
    say_estimated(result)
    say_model(result)
    say_left_out(result)
    for warning in result.warnings:
        if warning is not result.contradiction:
            say(f"warning: {warning}\n")
