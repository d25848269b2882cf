"""Draws the pictures of the concepts, for light and for dark pages: python docs/concepts/figures.py [NAME …].

Each picture shows the numbers of its page, `docs/concepts/NAME.md`, and is written to
`docs/images/concept-NAME.png` and `docs/images/concept-NAME-dark.png`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from themes import save

from reseau.adjust import GaussMarkov, Options, Parameters, adjust
from reseau.core.figures import ACCENT, BLUE, FAINT, INK, PALE, drawing
from reseau.designs import board, coded_sheet, coded_testfield, regular_reseau
from reseau.designs.drawing import Drawable, content_of
from reseau.io import Mark
from reseau.optics import PixelGrid, Pose, camera_model, convert, project
from reseau.optics.poses import matrix_to_vector

Array = NDArray[np.float64]
IMAGES = Path(__file__).resolve().parents[1] / "images"


def photographs() -> Figure:
    """Six photographs of a board, and the standard deviation of the principal distance by the tilt."""
    figure = Figure(figsize=(9.2, 3.1), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.5, 1.0))
    values = [900.0, 900.0, 359.5, 239.5, *np.zeros(5)]
    camera = camera_model("opencv").mapping(values, PixelGrid(720, 480, (1.0, 1.0)))
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    kinds = {
        "from the front": (0, 0, 0, (0, 0, 215)),
        "tilted by 35°": (0, 35, 0, (0, 0, 230)),
        "to the other side": (0, -35, 0, (0, 0, 230)),
        "and up": (35, 0, 0, (0, 0, 235)),
        "camera turned by 90°": (0, 25, 90, (0, 0, 255)),
        "in a corner": (-20, 25, 10, (58, 40, 250)),
    }
    for axes, (name, (up, aside, roll, middle)) in zip(left.subplots(2, 3).flat, kinds.items(), strict=True):
        turn = _turn(2, roll) @ _turn(1, aside) @ _turn(0, up)
        pose = Pose(matrix_to_vector(turn), -turn.T @ np.array(middle, dtype=float))
        for column in range(8):
            for row in range(5):
                if (column + row) % 2 == 0:
                    corners = 20.0 * (square + np.array([column - 4.0, row - 2.5]))
                    seen = project(camera, pose, np.column_stack([corners, np.zeros(4)])).xy
                    axes.add_patch(Polygon(seen, fc=INK, ec="none"))
        axes.set(xlim=(0, 720), ylim=(480, 0), aspect="equal", xticks=[], yticks=[])
        axes.set_title(name, loc="left", fontsize=9, pad=3)
    axes = right.subplots()
    degrees = np.geomspace(1.5, 45.0, 25)
    axes.loglog(degrees, [_focal_sigma(tilt) for tilt in degrees], color=BLUE)
    for tilt in (2.0, 10.0, 20.0, 40.0):
        sigma = _focal_sigma(tilt)
        axes.plot(tilt, sigma, "o", color=ACCENT, markersize=5)
        axes.annotate(f"{sigma:.2f} px", (tilt, sigma), xytext=(6, 4), textcoords="offset points")
    axes.set_title("principal distance of 1000 px: sigma, px", loc="left")
    axes.set_xlabel("tilt of four photographs of a plane, degrees")
    axes.set_xticks([2, 5, 10, 20, 40], ["2", "5", "10", "20", "40"])
    axes.set_yticks([0.1, 1.0, 10.0], ["0.1", "1", "10"])
    axes.minorticks_off()
    axes.set_xlim(1.4, 80.0)
    return figure


def _turn(axis: int, degrees: float) -> Array:
    rotation = np.zeros(3)
    rotation[axis] = np.deg2rad(degrees)
    return np.asarray(Pose(rotation, np.zeros(3)).matrix)


def _focal_sigma(degrees: float) -> float:
    """The standard deviation on the page: four photographs of 63 marks, tilted to either side."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-100, 100, 9), np.linspace(-70, 70, 7)))

    def images(p: Array) -> Array:
        f, poses = p[0], p[1:].reshape(4, 2)
        seen = [(f * x * np.cos(t) / (d + x * np.sin(t)), f * y / (d + x * np.sin(t))) for d, t in poses]
        return np.array(seen)

    names = ["f", *(f"{name}{k}" for k in range(4) for name in ("distance", "tilt"))]
    tilts = np.deg2rad(degrees) * np.array([1, -1, 1, -1])
    p = np.concatenate([[1000.0], np.column_stack([[400.0, 420, 440, 460], tilts]).ravel()])
    problem = GaussMarkov(images, images(p), 0.02, Parameters(names, p))
    return float(adjust(problem, Options(scale="a-priori")).required().sigma_of("f"))


def targets() -> Figure:
    """The usual targets, and why the centre of an ellipse is not the image of the centre of a circle."""
    figure = Figure(figsize=(9.2, 3.3), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.75, 1.0))
    kinds: dict[str, Drawable] = {
        "ChArUco board": board("charuco", 7, 5, 30.0),
        "chessboard": board("chess", 7, 5, 30.0),
        "circle grid": board("circles", 7, 5, 30.0),
        "AprilGrid": board("aprilgrid", 4, 3, 50.0),
        "sheet of disks": coded_sheet(11, 8, 20.0),
        "coded testfield": coded_testfield(),
        "reseau of crosses": regular_reseau(9, 6, 20.0, Mark(shape="cross", size=10.0, line_width=1.5)),
        "PuzzleBoard": board("puzzle", 9, 6, 20.0),
    }
    for axes, (name, design) in zip(left.subplots(2, 4).flat, kinds.items(), strict=True):
        drawn = content_of(design)
        marks = [*map(Polygon, drawn.polygons), *(Circle((x, y), r) for x, y, r in drawn.circles)]
        axes.add_collection(PatchCollection(marks, facecolor=INK, edgecolor="none", linewidth=0))
        axes.set(xlim=(drawn.low[0], drawn.high[0]), ylim=(drawn.low[1], drawn.high[1]), aspect="equal")
        axes.set_axis_off()
        axes.set_title(name, loc="left", fontsize=9, pad=3)
    axes = right.subplots()
    angle, tilt, radius, distance = np.linspace(0, 2 * np.pi, 400), np.deg2rad(40), 100.0, 500.0
    across, depth = radius * np.cos(angle), distance + radius * np.sin(angle) * np.sin(tilt)
    seen = 1000 * np.column_stack([across, radius * np.sin(angle) * np.cos(tilt)]) / depth[:, None]
    middle = (seen[:, 1].max() + seen[:, 1].min()) / 2
    axes.add_patch(Polygon(seen, fc=PALE, ec=INK, lw=0.8))
    axes.plot(0, 0, "+", color=BLUE, markersize=11, markeredgewidth=1.6)
    axes.annotate(
        "image of the\ncircle's centre", (0, 0), xytext=(10, 4), textcoords="offset points", color=BLUE
    )
    axes.plot(0, middle, "x", color=ACCENT, markersize=8, markeredgewidth=1.6)
    axes.annotate(
        "centre of the ellipse", (0, middle), xytext=(10, -13), textcoords="offset points", color=ACCENT
    )
    size = 1.15 * np.abs(seen).max(axis=0)
    axes.set(xlim=(-size[0], size[0]), ylim=(-size[1], size[1]), aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"a circle 400 px wide, tilted by 40°: {abs(middle):.0f} px", loc="left")
    axes.set_axis_off()
    return figure


def camera_models() -> Figure:
    """Projections, and what remains if one is replaced by another."""
    figure = Figure(figsize=(9.2, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    theta = np.deg2rad(np.linspace(0, 89, 300))
    curves = {
        "perspective (opencv, brown)": np.tan(theta),
        "stereographic": 2 * np.tan(theta / 2),
        "equidistant (fisheye)": theta,
        "equisolid": 2 * np.sin(theta / 2),
        "orthographic": np.sin(theta),
    }
    styles = zip(curves.items(), (INK, BLUE, ACCENT, FAINT, FAINT), ("-", "--", "-", "-.", ":"), strict=True)
    for (name, radius), colour, line in styles:
        left.plot(np.rad2deg(theta), radius, line, color=colour, label=name)
    left.set(xlim=(0, 89), ylim=(0, 2.6), xlabel="angle between ray and axis, degrees")
    left.set_title("radius in the image ÷ principal distance", loc="left")
    left.legend(frameon=False, fontsize=8.5, loc="upper left")
    image, fisheye = PixelGrid(640, 480, (1.0, 1.0)), camera_model("fisheye")
    lens = fisheye.mapping([600.0, 600.0, 319.5, 239.5, *np.zeros(8)], image)
    other = convert(lens, image, "opencv", free=("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"))
    # A vector of a fifth of a pixel is as long as 25 px of the image.
    by = {"angles": "xy", "scale_units": "xy", "scale": 0.2 / 25.0, "color": ACCENT, "width": 0.003}
    right.quiver(*other.xy.T, *other.difference.T, **by)
    right.quiver(560.0, 500.0, 0.2, 0.0, clip_on=False, **by)
    right.text(595.0, 500.0, "0.2 px", va="center")
    right.set(xlim=(0, 640), ylim=(480, 0), aspect="equal", xticks=[], yticks=[])
    right.set_title(f"a fisheye described by opencv with k1, k2: {other.rms_px:.3f} px rms", loc="left")
    return figure


def sigmas() -> Figure:
    """Errors of a mean of nine readings: by chance alone, and with an error that all readings share."""
    figure = Figure(figsize=(9.2, 2.9), layout="constrained")
    noise = np.random.default_rng(3).normal(0.0, 0.3, (10_000, 9))
    places, sigma = np.linspace(-0.5, 0.7, 61), 0.1
    for axes, shared in zip(figure.subplots(1, 2, sharey=True), (0.0, 0.2), strict=True):
        error = (noise + shared).mean(axis=1)
        inside = float((abs(error) < 2 * sigma).mean())
        axes.axvspan(-2 * sigma, 2 * sigma, color=PALE, lw=0)
        axes.hist(error, places, color=BLUE)
        axes.axvline(0.0, color=INK, lw=1.0)
        if shared:
            axes.axvline(shared, color=ACCENT, lw=1.2, ls="--")
            axes.annotate(
                "shared error", (shared, 1.0), xycoords=("data", "axes fraction"), xytext=(40, -12),
                textcoords="offset points", color=ACCENT,
            )  # fmt: skip
        axes.set_title(f"{'chance alone' if not shared else 'and a shared error of 0.2'}: "
                       f"{inside:.0%} within 2 sigma", loc="left")  # fmt: skip
        axes.set(xlabel="error of the mean", xlim=(-0.45, 0.65), yticks=[])
        for side in ("left", "right", "top"):
            axes.spines[side].set_visible(False)
    return figure


def redundancy() -> Figure:
    """The line of the page, its redundancy numbers, and what an error in two of its points does."""
    figure = Figure(figsize=(9.2, 3.1), layout="constrained")
    t, right_values = np.array([0.0, 1.0, 2.0, 3.0, 12.0]), np.array([1.02, 1.99, 3.01, 3.98, 13.0])

    def fitted(values: Array) -> tuple[Array, Array]:
        line = GaussMarkov(lambda x: x[0] + x[1] * t, values, 0.02, Parameters("ab", [0, 0]))
        fit = adjust(line).required()
        return np.asarray(fit.values), np.asarray(fit.redundancy_numbers)

    good, numbers = fitted(right_values)
    axes = figure.subplots(1, 3)
    axes[0].bar(range(5), numbers, color=[BLUE] * 4 + [ACCENT], width=0.6)
    for k, number in enumerate(numbers):
        axes[0].annotate(f"{number:.2f}", (k, number), xytext=(0, 2), textcoords="offset points", ha="center")
    axes[0].set_xticks(range(5), [f"t = {value:.0f}" for value in t])
    axes[0].set(ylim=(0, 1), yticks=[0, 0.5, 1])
    axes[0].set_title("redundancy numbers", loc="left")
    for ax, wrong in zip(axes[1:], (2, 4), strict=True):
        values = right_values.copy()
        values[wrong] += 0.3
        found, _ = fitted(values)
        # Shown are deviations from the right line: the line itself would hide them.
        base = good[0] + good[1] * t
        ends = np.array([-0.5, 13.0])
        ax.plot(ends, found @ [np.ones(2), ends] - good @ [np.ones(2), ends], color=BLUE, label="line found")
        ax.plot(ends, np.zeros(2), color=FAINT, lw=0.8, ls="--", label="right line")
        others = np.arange(5) != wrong
        ax.plot(t[others], (values - base)[others], "o", color=INK, markersize=4)
        ax.plot(t[wrong], (values - base)[wrong], "o", color=ACCENT, markersize=6)
        rest = values[wrong] - found @ [1.0, t[wrong]]
        ax.vlines(t[wrong], values[wrong] - base[wrong] - rest, values[wrong] - base[wrong], color=ACCENT)
        ax.set(ylim=(-0.1, 0.36), xlabel="t")
        ax.set_title(f"error of 0.3 at t = {t[wrong]:.0f}: residual {rest:.2f}", loc="left")
    axes[1].legend(frameon=False, fontsize=8.5, loc="upper right")
    return figure


def global_test() -> Figure:
    """A curve described by a line and by a cubic: residuals, and their statistic against its distribution."""
    figure = Figure(figsize=(9.2, 3.1), layout="constrained")
    x = np.linspace(-1, 1, 41)
    measured = 0.1 * x**3 + np.random.default_rng(2).normal(0.0, 0.01, 41)
    axes = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    axes[1].sharey(axes[0])
    for ax, name, terms, colour in (
        (axes[0], "line", [x**0, x], ACCENT),
        (axes[1], "cubic", [x**0, x, x**3], BLUE),
    ):
        unknowns = Parameters([f"a{k}" for k in range(len(terms))], [0.0] * len(terms))
        model = GaussMarkov(lambda p, terms=terms: np.asarray(p) @ terms, measured, 0.01, unknowns)
        fit = adjust(model).required()
        test = fit.global_test()
        assert test is not None
        left = measured - np.asarray(fit.values) @ terms
        ax.axhspan(-0.01, 0.01, color=PALE, lw=0)
        ax.vlines(x, 0, left, color=colour, lw=1.0)
        ax.plot(x, left, "o", color=colour, markersize=3)
        ax.axhline(0, color=FAINT, lw=0.8)
        ax.set_title(f"{name}: sigma0 {fit.sigma0:.2f}", loc="left")
        ax.set_xlabel("place")
        axes[2].axvline(test.statistic, color=colour, lw=1.6)
        axes[2].annotate(
            f"{name}: {test.statistic:.0f}", (test.statistic, 0.95), xycoords=("data", "axes fraction"),
            xytext=(-5 if name == "line" else 22, -10), textcoords="offset points", color=colour,
            ha="right" if name == "line" else "left",
        )  # fmt: skip
    places = np.linspace(5, 160, 400)
    density = stats.chi2(38).pdf(places)
    axes[2].fill_between(places, density, color=PALE, lw=0)
    axes[2].plot(places, density, color=INK, lw=1.0)
    axes[2].annotate("expected by chance", (52, 0.02), xytext=(8, 4), textcoords="offset points")
    axes[2].set(yticks=[], ylim=(0, None), xlabel="sum of squared residuals ÷ their variances")
    axes[2].set_title("statistic", loc="left")
    axes[0].set_ylabel("residual; band: ± 1 sigma")
    for side in ("left", "right", "top"):
        axes[2].spines[side].set_visible(False)
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {
    "photographs": photographs,
    "targets": targets,
    "camera-model": camera_models,
    "sigmas": sigmas,
    "redundancy": redundancy,
    "global-test": global_test,
}


def main() -> None:
    """Draw the pictures that are named, or all."""
    for name in sys.argv[1:] or PICTURES:
        with drawing():
            save(PICTURES[name](), IMAGES / f"concept-{name}.png")
        print(IMAGES / f"concept-{name}.png")


if __name__ == "__main__":
    main()
