"""The report of a sensor calibration: a self-contained page, the same bytes for the same input."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.layout_engine import ConstrainedLayoutEngine

from ..core.data import Array
from ..core.failure import Failure
from ..core.figures import ACCENT, BLUE, FAINT, INK, label_axes, sheet, to_svg
from ..core.provenance import Provenance
from ..sensor import EdgeSpread, FreeCurve, Linearity
from ..sensor.sensor import SensorResult
from .template import rendered

_SIZE = (8.6, 3.6)
_MEANING = {
    "gain": "gain, electrons per grey value",
    "read_noise": "read noise",
    "full_well": "full well",
    "b2": "linearity, quadratic term",
    "b3": "linearity, cubic term",
    "psf": "width of a Gaussian point-spread function",
    "mtf50": "frequency of 50 % modulation, Gaussian",
    "mtf50_free": "frequency of 50 % modulation, free curve",
    "mtf_nyquist_free": "modulation at half a cycle per pixel, free curve",
}
_UNITS = {"e-/DN": "e⁻/DN", "e-": "e⁻", "1/px": "px⁻¹", "1": ""}


def sensor_report(result: SensorResult, *, title: str, provenance: Provenance | None = None) -> str:
    """Render the report of a sensor's calibration.

    Parameters
    ----------
    result : SensorResult
        The calibration.
    title : str
        Heading of the page.
    provenance : Provenance, optional
        Inputs, options, version.

    Returns
    -------
    str
        An HTML page without any external resource and without clock times.
    """
    edge = result.edge
    return rendered(
        "sensor.html.j2",
        title=title,
        summary=_summary(result),
        rows=_rows(result),
        transfer=Markup(transfer_figure(result)),
        failed=edge.reason if isinstance(edge, Failure) else "",
        mtf=Markup(mtf_figure(edge)) if isinstance(edge, EdgeSpread) else None,
        edge=_edge(edge) if isinstance(edge, EdgeSpread) else None,
        provenance=(provenance or Provenance()).to_dict(),
    )


def _summary(result: SensorResult) -> list[tuple[str, str, str]]:
    height, width = result.fields.bias.shape
    levels = result.transfer.curve
    return [
        (f"{width} × {height}", "px", "calibrated region"),
        (f"{levels.bright.sum()} + {(~levels.bright).sum()}", "", "bright and dark exposures"),
        (f"{result.dsnu:.3g}", "DN", "σ of the dark signal between pixels (DSNU)"),
        (f"{100 * result.prnu:.3g}", "%", "σ of the response, including non-uniform light (PRNU)"),
        (f"{int(result.fields.defects.sum())}", "", "defective pixels"),
    ]


def _rows(result: SensorResult) -> list[tuple[str, str, str, str]]:
    """Estimates: meaning, value and sigma with the same decimals, unit."""
    rows = []
    for name, each in result.quantities().items():
        digits = 1 - int(np.floor(np.log10(each.sigma))) if each.sigma > 0 else 4
        value, sigma = (f"{number:.{max(digits, 0)}f}" for number in (each.value, each.sigma))
        rows.append((_MEANING[name], value, sigma, _UNITS.get(each.unit, each.unit)))
    return rows


def _edge(edge: EdgeSpread) -> dict[str, object]:
    """Tests of the edge, and the free curve in steps of a sixteenth."""
    tests = [
        (
            test["name"],
            "yes" if test["passed"] else "no",
            f"{test['p']:.2g}" if test["p"] >= 5e-4 else "< 0.001",
            f"{test['statistic']:.3g}",
        )
        for test in edge.tests()
    ]
    curve: list[tuple[str, ...]] = []
    if isinstance(edge.free, FreeCurve):
        columns = edge.to_model()["mtf"]
        numbers = zip(
            *(columns[name][::2] for name in ("frequency", "mtf", "sigma", "gaussian")), strict=True
        )
        curve = [(f"{f:.4f}", f"{m:.4f}", f"{s:.4f}", f"{g:.4f}") for f, m, s, g in numbers]
    return {
        "angle": f"{abs(np.rad2deg(edge.angle)):.2f}",
        "tests": tests,
        "curve": curve,
        "failed": edge.free.reason if isinstance(edge.free, Failure) else "",
    }


def mtf_figure(edge: EdgeSpread) -> str:
    """Draw the free curve with its 95 % band, the Gaussian curve, and the line-spread functions.

    Returns
    -------
    str
        An SVG element.
    """
    with sheet(_SIZE, layout=ConstrainedLayoutEngine(wspace=0.06)) as figure:
        left, right = figure.subplots(1, 2)
        frequency = np.linspace(0.0, 1.0, 161)
        left.axvline(0.5, color=FAINT, lw=0.6)
        left.annotate(
            "Nyquist", (0.5, 1.02), xytext=(4, 0), textcoords="offset points", color=FAINT, fontsize=8
        )
        left.plot(frequency, edge.mtf(frequency), color=INK, lw=0.9, ls=(0, (4, 3)), label="Gaussian")
        if isinstance(edge.free, FreeCurve):
            _free(left, edge.free)
            _spread(right, edge, edge.free)
        left.set(xlim=(0, 1), ylim=(0, 1.08))
        left.legend(frameon=False, fontsize=8.5, loc="upper right", bbox_to_anchor=(1.0, 0.94))
        label_axes(left, "modulation transfer", "cycles per pixel, along the normal", "")
        label_axes(right, "line-spread function", "distance from the edge / px", "share of the step per px")
        return to_svg(figure)


def _free(axes: Axes, free: FreeCurve) -> None:
    frequency = np.linspace(0.0, free.limit, 161)
    value, sigma = free.mtf(frequency)
    band = np.clip(np.stack([value - 1.96 * sigma, value + 1.96 * sigma]), 0.0, None)
    axes.fill_between(frequency, *band, color=BLUE, alpha=0.25, lw=0)
    axes.plot(frequency, value, color=BLUE, lw=1.2, label="free, with 95 %")
    if free.mtf50 is not None:
        axes.plot(free.mtf50[0], 0.5, "o", color=ACCENT, markersize=3.5)


def _spread(axes: Axes, edge: EdgeSpread, free: FreeCurve) -> None:
    reach = 4 * abs(edge.fit["psf"]) + 2.5
    at = np.linspace(-reach, reach, 401)
    found, gaussian = free.line_spread(at)
    axes.plot(at, gaussian, color=INK, lw=0.9, ls=(0, (4, 3)))
    axes.plot(at, found, color=BLUE, lw=1.2)
    axes.set_xlim(-reach, reach)


def transfer_figure(result: SensorResult) -> str:
    """Draw photon transfer and linearity: levels, fitted curves, and levels close to saturation.

    Returns
    -------
    str
        An SVG element.
    """
    curve, fit = result.transfer.curve, result.transfer.fit
    lit, amount = curve.bright, curve.exposure_us / 1000 if curve.light is None else curve.light
    with sheet(_SIZE, layout=ConstrainedLayoutEngine(wspace=0.06)) as figure:
        left, right = figure.subplots(1, 2)
        signal: Array = np.linspace(0.0, float(curve.signal[curve.usable].max()) * 1.02, 81)
        linear, bend = (signal, np.ones_like(signal))
        if isinstance(result.linearity, Linearity):
            linear, bend = result.linearity.straight(signal)
        left.plot(
            signal, fit["read_noise"] ** 2 + 1 / 12 + linear / bend**2 / fit["gain"], color=BLUE, lw=1.0
        )
        for used, colour in ((curve.usable, INK), (~curve.usable, FAINT)):
            left.plot(curve.signal[used], curve.variance[used], "o", color=colour, markersize=3)
            part = used & lit
            right.plot(amount[part], curve.signal[part], "o", color=colour, markersize=3)
        if isinstance(result.linearity, Linearity):
            part = lit & curve.usable
            straight = result.linearity.straight(curve.signal[part])[0]
            scale = float(straight @ amount[part]) / float(amount[part] @ amount[part])
            right.plot(linear / scale, signal, color=BLUE, lw=1.0, zorder=0)
        label_axes(left, "photon transfer", "signal / DN", "variance / DN²")
        label_axes(
            right, "response to light", "exposure / ms" if curve.light is None else "light", "signal / DN"
        )
        return to_svg(figure)
