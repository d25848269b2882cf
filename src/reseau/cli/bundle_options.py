"""Options and output shared by `reseau bundle` and `reseau calibrate`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .common import say

if TYPE_CHECKING:
    from ..bundle import PriorInfluence, Result
    from ..bundle.diagnostics.estimates import (
        CameraEstimate,
        MotionEstimates,
        RefractionEstimate,
        RigEstimate,
        StageEstimate,
    )
    from ..calibration import FieldDifference


# Parameters of a camera that are printed at most.
_MOST = 60
_LARGER = 1.05
"""Ratio of a standard deviation to the formal one from which both are printed: less changes no digit."""


def level_of(value: float | None, name: str) -> float | None:
    """Check a significance level, if one is given.

    Raises
    ------
    UsageError
        When it is not between 0 and 1.
    """
    from ..core.errors import UsageError

    if value is not None and not 0 < value < 1:
        raise UsageError(f"{value:g} is not between 0 and 1", where=name)
    return value


def positive(distances: list[float] | None) -> list[float]:
    """Check distances before the computation.

    Raises
    ------
    UsageError
        When a distance is not positive.
    """
    from ..core.errors import UsageError

    for distance in distances or []:
        if not distance > 0:
            raise UsageError(f"{distance:g} is not positive", where="--distance")
    return distances or []


def say_parameters(camera: CameraEstimate) -> None:
    """Print the parameters of a camera, with the formal sigmas where these are smaller."""
    from ..core.numbers import at_power, power

    rows = zip(
        camera.parameters, camera.values.tolist(), camera.sigma.tolist(), camera.sigma_formal.tolist(),
        camera.texts, strict=True,
    )  # fmt: skip
    for k, (name, value, sigma, formal, text) in enumerate(rows):
        if k == _MOST and len(camera.parameters) > _MOST + 1:
            say(f"  … and {len(camera.parameters) - k} more\n")
            break
        more = ""
        if sigma > _LARGER * formal:
            shown = power(value, sigma)
            ten = "e" + shown.exponent.replace("\u2212", "-") if shown.exponent else ""
            more = f" (formal: {at_power(formal, shown)}{ten})"
        say(f"  {name:<6} {text}{more}\n")


def say_priors(found: PriorInfluence | None) -> None:
    """Print how much observed parameters determine a camera; nothing without any."""
    import numpy as np

    if found is None:
        return
    count = len(found.parameters)
    weak = int((found.share > 0.5).sum())
    ratio = found.sigma_images / np.where(found.sigma > 0, found.sigma, 1.0)
    say(
        f"  {count} parameters are observed with a sigma: the image points determine {found.determined:.1f} "
        f"of them, {weak} are determined mostly by their own observation\n"
        f"  sigmas that the noise of the image points causes: {np.median(ratio):.2f} of these sigmas in the "
        f"median; sigma0 without the observed parameters {found.sigma0:.4g}\n"
    )


def say_estimated(result: Result) -> None:
    """Print what was estimated besides cameras and points."""
    if result.rig is not None:
        say_rig(result.rig)
    if result.stage is not None:
        say_turntable(result.stage)
    if result.motion is not None:
        say_motion(result.motion)
    if result.refraction is not None:
        say("windows and media\n")
        say_refraction(result.refraction)


def say_refraction(found: RefractionEstimate) -> None:
    """Print the parameters of windows and media, their tests against given values, and their partners."""
    from ..core.numbers import measured

    width = max(len(name) for name in found.parameters)
    for k, name in enumerate(found.parameters):
        test, (partner, r) = found.tests[k], found.partners[k]
        value = measured(float(found.values[k]), float(found.sigma[k]), found.units[k])
        differs = "differs" if test.significant else "does not differ"
        say(
            f"  {name:<{width}}  {value}: {differs} from {found.given[k]:g} (p = {test.p:.2g}); "
            f"correlation {r:+.2f} with {partner}\n"
        )


def say_rig(found: RigEstimate) -> None:
    """Print the relative orientations of the cameras of a rig."""
    import numpy as np

    from ..core.numbers import measured

    for k, (camera, reference) in enumerate(zip(found.cameras, found.references, strict=True)):
        base = ", ".join(
            measured(float(v), float(s)) for v, s in zip(found.base[k], found.sigma[k, 3:], strict=True)
        )
        turn = float(np.rad2deg(found.sigma[k, :3].max()))
        say(
            f"camera {camera} from {reference}: base {base} {found.unit}, length "
            f"{measured(float(found.length[k]), float(found.length_sigma[k]), found.unit)}; turned by "
            f"{measured(float(found.angles[k]), turn, 'deg')}\n"
        )


def say_turntable(found: StageEstimate) -> None:
    """Print the axis of a turntable, and how its angles differ from those given."""
    import numpy as np

    from ..core.numbers import measured

    if found.kind != "rotary":
        return
    sigma = np.sqrt(np.diag(found.cov))
    one, other = (
        ", ".join(measured(float(v), float(s)) for v, s in zip(values, spread, strict=True))
        for values, spread in ((found.direction, sigma[:3]), (found.position, sigma[3:]))
    )
    turned, shifted = (
        f"± {value:.2g} {unit}" if value > 0 else "held"
        for value, unit in ((np.rad2deg(found.direction_sigma), "deg"), (found.position_sigma, found.unit))
    )
    say(f"turntable: axis {one} ({turned}) through {other} {found.unit} ({shifted})\n")
    free = found.reading_sigma > 0
    if free.any():
        typical = np.rad2deg(np.median(found.reading_sigma[free]))
        text = f"  {int(free.sum())} angles estimated, ± {typical:.2g} deg"
        off = found.residual[free & np.isfinite(found.residual)]
        if len(off):
            text += f"; they differ from the given ones by {np.rad2deg(np.sqrt(np.mean(off**2))):.2g} deg rms"
        say(text + "\n")


def say_motion(found: MotionEstimates) -> None:
    """Print how fast the cameras of images with a shutter move, and how much of it is significant."""
    import numpy as np

    sigma, size = found.sigma, np.abs(found.values)
    median = np.median(sigma, axis=0)
    speed = " ".join(f"{np.median(column):.3g}" for column in size.T[:3])
    turn = " ".join(f"{np.median(column):.3g}" for column in size.T[3:])
    significant = sum(test.significant for test in found.tests)
    say(
        f"motion of {len(found.names)} images, medians: |v| {speed} {found.unit}/s "
        f"(sigma {' '.join(f'{s:.2g}' for s in median[:3])}), |w| {turn} rad/s "
        f"(sigma {' '.join(f'{s:.2g}' for s in median[3:])}); {significant} of {len(found.tests)} components "
        "are significant\n"
    )


def say_left_out(result: Result) -> None:
    """Print the rejected image points: gross errors by image, others with their test values."""
    gross = dict[str, list[str]]()
    for image, point, value, critical in result.rejected_points():
        if value == value:
            say(f"left out: point {point} in image {image}, test value {value:.2f} above {critical:.2f}\n")
        else:
            gross.setdefault(image, []).append(point)
    for image, points in gross.items():
        say(f"gross errors left out in image {image}: points {', '.join(points)}\n")


def say_model(result: Result) -> None:
    """Print variance components and dropped parameters."""
    found = result.components
    if found is not None:
        for name, factor, sigma in zip(found.names, found.factors, found.sigma, strict=True):
            say(f"sigmas of {name} times {factor:.3f} ± {sigma:.2g}\n")
    for step in result.eliminated or ():
        test = f"|t| {step.test.statistic:.2f}, p = {step.test.p:.2g}, sigma0 without it {step.sigma0:.5g}"
        say(f"dropped: {step.test.name} of camera {step.camera}: {test}\n")
    if result.eliminated == ():
        say("all distortion parameters are significant; none was dropped\n")
    if result.validation is not None:
        before, after = result.validation
        say(
            f"cross-validation: predicted image coordinates differ by {before:.4g} sigmas rms with all "
            f"parameters, by {after:.4g} with those kept\n"
        )


def say_difference(name: str, found: FieldDifference) -> None:
    """Print the difference of two calibrations."""
    import numpy as np

    size = np.sqrt(np.nanmean((found.difference**2).sum(axis=2)))
    known = np.isfinite(found.p_at)
    share = float((found.p_at[known] < 0.01).mean()) if known.any() else 0.0
    test = f"χ² {found.statistic:.4g} with {found.degrees:.4g} degrees of freedom, p = {found.p_alone:.2g}"
    if found.by_others:
        test += f"; with other models that are possible, {len(found.by_others) + 1} pairs, p = {found.p:.2g}"
    say(
        f"difference to {name}: {size:.2g} px rms, {test}\n"
        f"  significant at 1 % over {100 * share:.0f} % of the image\n"
    )
