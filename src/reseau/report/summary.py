"""The comparison with the truth as a short text table."""

from __future__ import annotations

from .truth import BodyComparison, CameraComparison, Comparison, Factor, Pair, RodComparison

_LABEL = 33


def comparison_table(truth: Comparison) -> str:
    """Return the comparison as text, at most 80 characters wide."""
    lines = _camera(truth.camera, truth.unit)
    if truth.rods is not None:
        lines += ["", *_rods(truth.rods, truth.unit)]
    for body in truth.bodies:
        lines += ["", *_body(body, truth.unit)]
    if truth.factors:
        lines += ["", *_factors(truth.factors, truth.unit)]
    return "\n".join(lines) + "\n"


def _line(label: str, *pairs: Pair | None, decimals: int = 4) -> str:
    """A label and pairs of numbers; blank where there is none."""
    cells = "".join(
        " " * 17
        if pair is None
        else "".join(f"{value:{width}.{decimals}f}" for value, width in zip(pair, (9, 8), strict=True))
        for pair in pairs
    )
    return f"  {label:{_LABEL - 2}}{cells}".rstrip()


def _head(label: str, *groups: str) -> list[str]:
    return [(f"{label:{_LABEL}}" + "".join(f"{group:>17}" for group in groups)).rstrip()]


def _camera(camera: CameraComparison, unit: str) -> list[str]:
    lines = _head(f"PHOTO I, rms in {unit} (x, y)", "fitted marks", "check marks")
    lines += [_line(stage.name, stage.fitted, stage.check) for stage in camera.stages]
    lines += [
        _line("approximation by the model", camera.approximation),
        _line("error of the positions, px", camera.position_px),
        _line("… in units of sigma", camera.position_normalised, camera.check_normalised, decimals=2),
    ]
    return lines


def _rods(rods: RodComparison, unit: str) -> list[str]:
    return [
        *_head(f"PHOTO II, {rods.rods} of {rods.known} rods"),
        _line("error of the positions, px", rods.position_px),
        _line("… in units of sigma", rods.position_normalised, decimals=2),
        _line(f"true minus design coordinates, {unit}", rods.made),
    ]


def _body(body: BodyComparison, unit: str) -> list[str]:
    return [
        *_head(f"PHOTO III, {body.points} of {body.known} points"),
        _line("error of the positions, px", body.position_px),
        _line("… in units of sigma", body.position_normalised, decimals=2),
        _line(f"error of true coordinates, {unit}", body.error),
        _line(f"their sigmas, {unit}", body.sigma),
        _line("error in units of sigma", body.error_normalised, decimals=2),
    ]


def _factors(factors: tuple[Factor, ...], unit: str) -> list[str]:
    columns = [("rods", [f.rods for f in factors]), ("check rods", [f.check for f in factors])]
    columns += [("PHOTO III", [f.body for f in factors]), ("rods true", [f.ideal for f in factors])]
    shown = [(name, pairs) for name, pairs in columns if any(pair is not None for pair in pairs)]
    lines = _head(f"factor by factor, rms in {unit}", *(name for name, _ in shown))
    for i, factor in enumerate(factors):
        lines.append(_line(factor.name, *(pairs[i] for _, pairs in shown), decimals=3))
    return lines
