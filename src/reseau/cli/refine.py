"""`reseau refine`: the oscilloscope procedure on files."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from .common import AsJson, Out, progress, read_photo, required, say, suffix_of, writable

__all__ = ["refine"]


def refine(
    photo_i: Annotated[Path, typer.Option(help="PHOTO I: the reseau alone; an image or coordinates.")],
    reseau: Annotated[Path, typer.Option(help="Design of the reseau.")],
    out: Out = None,
    report: Annotated[Path | None, typer.Option(help="Report to write, HTML.")] = None,
    alpha: Annotated[float, typer.Option(help="Level of the tests of the coefficients.")] = 0.05,
    check: Annotated[str, typer.Option(help="Marks held out as check marks: A1,B2,…")] = "",
    as_json: AsJson = False,
) -> None:
    """Correct a camera by PHOTO I of a reseau: distortions of lens and film."""
    from ..data import Frame
    from ..errors import UsageError
    from ..formats import ReseauDesign, write_whole
    from ..procedures.oscilloscope import photo_i as procedure
    from ..provenance import Provenance, sha256_of

    if not 0 < alpha < 1:
        raise UsageError(f"{alpha:g} is not between 0 and 1", where="--alpha")
    for path, suffix in ((out, ".json"), (report, ".html")):
        if path is not None:
            suffix_of(writable(path), (suffix,))
    design = ReseauDesign.read(reseau)
    held = tuple(name for name in check.split(",") if name)
    unknown = [name for name in held if name not in design.ids]
    if unknown:
        raise UsageError(f"names {unknown[0]!r}, which is none of the marks", where="--check")
    photo = read_photo(photo_i)
    with progress(f"refining {photo_i.name}", 1):
        found = required(procedure(photo, design, alpha=alpha, check=held), photo_i)
    provenance = Provenance(
        {photo_i.name: sha256_of(photo_i), reseau.name: sha256_of(reseau)},
        {"alpha": alpha, "check": list(held)},
    )
    calibration = found.camera.calibration(
        name=f"{design.name} {photo_i.stem}",
        provenance=provenance.to_dict(),
        times={"computed": datetime.now(UTC).isoformat(timespec="seconds")},
    )
    page = None
    if report is not None:
        from ..report import photo_i_report

        frame = photo if isinstance(photo, Frame) else None
        page = photo_i_report(found, design, frame=frame, title=photo_i.name, provenance=provenance)
    if out is not None:
        write_whole(out, calibration.to_json())
    if page is not None and report is not None:
        write_whole(report, page)
    if as_json:
        say(calibration.to_json())
        return
    fit = found.camera.fit
    rms = (fit.residuals**2).mean(axis=0) ** 0.5 if fit else (0.0, 0.0)
    say(f"{photo_i.name}: {len(found.points)} marks, {len(found.camera.model.names)} coefficients kept\n")
    say(f"residuals {rms[0]:.4f} {design.unit} in x, {rms[1]:.4f} {design.unit} in y (rms)\n")
