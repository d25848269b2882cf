"""`reseau demo`: the whole way from a simulated bench to a calibration and its report."""

from __future__ import annotations

import os
import shutil
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from .common import AsJson, progress, required, say

if TYPE_CHECKING:
    from ..data import Frame
    from ..formats import ReseauDesign
    from ..optics import PlaneMapping

__all__ = ["demo"]

_BENCH = "simulated-bench"


class Bench(Protocol):
    """What the demo needs of a simulated bench; see the entry point ``simulated-bench``."""

    @property
    def design(self) -> ReseauDesign:
        """The reseau in front of the screen."""

    def photo_i(self) -> Frame:
        """PHOTO I."""

    def check_marks(self) -> tuple[str, ...]:
        """Marks to hold out."""

    def view(self) -> PlaneMapping:
        """The truth: from the plane of the reseau to the image."""


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path("out"),
    seed: Annotated[int, typer.Option(min=0, help="Of all that is random; same seed, same bytes.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Photograph a simulated reseau, correct the camera, and report."""
    from ..errors import InputError
    from ..provenance import canonical_json
    from ..report import photo_i_report
    from ..report.comparison import compare_with_truth, comparison_table
    from ..report.overview import overview_png

    if out.exists() and not out.is_dir():
        raise InputError("is a file", where=out, do="name a folder")
    if not out.absolute().parent.is_dir():
        raise InputError("has no such folder", where=out.parent, do="create it first")
    with progress("photographing the reseau", 4) as step:
        bench = _bench(seed)
        frame, check = bench.photo_i(), bench.check_marks()
        step("measuring its marks")
        found, provenance = _refined(bench, frame, check, seed)
        step("comparing with the truth")
        truth = compare_with_truth(found, bench.design, bench.view())
        step("writing the report")
        calibration = found.camera.calibration(
            name=f"simulated bench, seed {seed}",
            provenance=provenance.to_dict(),
            times={"computed": datetime.now(UTC).isoformat(timespec="seconds")},
        )
        page = photo_i_report(
            found,
            bench.design,
            frame=frame,
            title=f"PHOTO I of the simulated bench, seed {seed}",
            provenance=provenance,
            truth=truth,
        )
        assert found.measured is not None  # from a frame it was measured
        measurement = found.measured.measurement()
        _write_folder(
            out,
            frame,
            {
                "report.html": page,
                "overview.png": overview_png(found, frame, bench.design.unit),
                "calibration.json": calibration.to_json(),
                "measurement.json": measurement.to_json(),
                "design.json": bench.design.to_json(),
                "comparison.json": canonical_json(truth.to_dict()),
            },
        )
        step()
    if as_json:
        say(canonical_json(truth.to_dict()))
    else:
        say(f"{measurement.found} of {measurement.expected} marks measured\n\n")
        say(comparison_table(truth))
        say(f"\nopen {out / 'report.html'}\n")


def _bench(seed: int) -> Bench:
    """The simulated bench, found by its entry point.

    Raises
    ------
    UsageError
        When no installed package offers one.
    """
    from importlib.metadata import entry_points

    from ..errors import UsageError

    found = list(entry_points(group="reseau.instruments", name=_BENCH))
    if not found:
        raise UsageError(f"no installed package offers {_BENCH!r}", do="install reseau anew")
    bench: Bench = found[0].load()(seed)
    return bench


def _refined(bench: Bench, frame: Frame, check: tuple[str, ...], seed: int) -> tuple[Any, Any]:
    from ..procedures.oscilloscope import photo_i
    from ..provenance import Provenance, sha256_of

    found = required(photo_i(frame, bench.design, check=check), frame.name)
    inputs = {frame.name: frame.sha256, bench.design.name: sha256_of(bench.design.to_json().encode())}
    return found, Provenance(inputs, {"seed": seed, "check": list(check), "alpha": 0.05})


def _write_folder(out: Path, frame: Frame, documents: dict[str, str | bytes]) -> None:
    """Write all files beside their place first, then move them there: an error leaves what was before.

    Raises
    ------
    InputError
        When the place cannot be written to.
    """
    from ..errors import InputError
    from ..formats import write_whole
    from ..images import write_image

    try:
        draft = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.absolute().parent))
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=out) from None
    try:
        write_image(draft / "photo_i.png", frame.pixels)
        for name, content in documents.items():
            write_whole(draft / name, content)
        draft.chmod(0o755)
        if not out.exists():
            draft.replace(out)
            return
        for path in sorted(draft.iterdir()):
            os.replace(path, out / path.name)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=out) from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)
