"""What `reseau bundle` and `reseau calibrate` have in common: options, and what is said of a result."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .common import say, suffix_of, writable

if TYPE_CHECKING:
    from ..bundle import Kind, Result, Searched
    from ..calibration import FieldDifference

__all__ = [
    "Alpha",
    "ComponentsOf",
    "Distances",
    "Eliminate",
    "Reject",
    "component_kind",
    "level_of",
    "outputs",
    "positive",
    "say_difference",
    "say_left_out",
    "say_model",
]


class Components(StrEnum):
    """What gets a factor of its own on the standard deviations of its image coordinates."""

    AXES = "axes"
    IMAGES = "images"
    CAMERAS = "cameras"


Reject = Annotated[bool, typer.Option("--reject", help="Leave blunders out, by data snooping.")]
Alpha = Annotated[float, typer.Option(help="Level of the single test of data snooping.")]
ComponentsOf = Annotated[
    Components | None,
    typer.Option(
        "--components", help="Variance components: x against y, image by image, or camera by camera."
    ),
]
Eliminate = Annotated[
    float | None,
    typer.Option(help="Drop distortion parameters not significant at this level, as 0.05; cross-validate."),
]
Distances = Annotated[
    list[float] | None,
    typer.Option(
        "--distance", help="Distance at which the report maps how well the projection is known; repeatable."
    ),
]


def component_kind(chosen: Components | None) -> Kind | None:
    """The kind of variance components asked for."""
    return None if chosen is None else chosen.value


def level_of(value: float | None, name: str) -> float | None:
    """A level, where one is given.

    Raises
    ------
    UsageError
        When it is not between 0 and 1.
    """
    from ..core.errors import UsageError

    if value is not None and not 0 < value < 1:
        raise UsageError(f"{value:g} is not between 0 and 1", where=name)
    return value


def outputs(out: Path | None, report: Path | None) -> None:
    """Ask before the work begins whether result and report can be written.

    Raises
    ------
    InputError
        When a folder does not exist.
    UsageError
        When one has another suffix than it should.
    """
    for path, suffixes in ((out, (".json",)), (report, (".html",))):
        if path is not None:
            suffix_of(writable(path), suffixes)


def positive(distances: list[float] | None) -> list[float]:
    """Distances, asked before the work begins.

    Raises
    ------
    UsageError
        When one is not above zero.
    """
    from ..core.errors import UsageError

    for distance in distances or []:
        if not distance > 0:
            raise UsageError(f"{distance:g} is not above zero", where="--distance")
    return distances or []


def say_left_out(result: Result) -> None:
    """What data snooping left out, with the test values."""
    import numpy as np

    tests = result.rejected_tests[np.flatnonzero(result.rejected)]
    for image, point, (value, critical) in zip(*result.rejected_names(), tests, strict=True):
        say(f"left out: point {point} in image {image}, test value {value:.1f} above {critical:.1f}\n")


def say_model(searched: Searched) -> None:
    """Variance components and parameters dropped."""
    found = searched.components
    if found is not None:
        for name, factor, sigma in zip(found.names, found.factors, found.sigma, strict=True):
            say(f"sigmas of {name} times {factor:.3f} ± {sigma:.2g}\n")
    for step in searched.eliminated or ():
        said = f"|t| {step.test.statistic:.2f}, p = {step.test.p:.2g}, sigma0 without it {step.sigma0:.5g}"
        say(f"dropped: {step.test.name} of camera {step.camera}: {said}\n")
    if searched.eliminated == ():
        say("all distortion parameters are significant: none was dropped\n")
    if searched.validation is not None:
        before, after = searched.validation
        say(
            f"cross-validation: points predicted without them are off by {before:.4g} sigmas with all "
            f"parameters, by {after:.4g} with those that stayed\n"
        )


def say_difference(name: str, found: FieldDifference) -> None:
    """A difference of calibrations in one line."""
    import numpy as np

    size = np.sqrt(np.nanmean((found.difference**2).sum(axis=2)))
    known = np.isfinite(found.p_at)
    share = float((found.p_at[known] < 0.01).mean()) if known.any() else 0.0
    test = f"χ² {found.statistic:.4g} with {found.degrees} degrees of freedom, p = {found.p:.2g}"
    say(
        f"beside {name}: {size:.2g} px rms, {test}\n"
        f"  significant at 1 % over {100 * share:.0f} % of the image\n"
    )
