"""Draws the packages and their layers, as import-linter checks them: python docs/layers.py."""

from __future__ import annotations

import tomllib
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from themes import save

from reseau.core.figures import BLUE, FAINT, INK, PALE, drawing

ROOT = Path(__file__).resolve().parents[1]
ABOUT = {
    "cli": "the commands",
    "service": "schedules, certificates, pages",
    "sessions": "live and again",
    "api": "import reseau",
    "report": "figures, pages",
    "procedures": "one for each publication",
    "capture": "bench, plans",
    "exchange": "other programs' files",
    "execution": "processes, clusters",
    "bundle": "networks adjusted",
    "refine": "errors corrected",
    "sensor": "noise, sharpness",
    "archive": "frames and results",
    "measure": "image → coordinates",
    "calibration": "the document, its mapping",
    "designs": "targets",
    "io": "images, documents",
    "adjust": "least squares",
    "optics": "image formation",
    "instruments": "what an instrument is",
    "core": "frames, points, errors",
}


def layers() -> list[list[str]]:
    """Packages of each layer, from the top."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    named = next(
        each["layers"] for each in contracts if each["type"] == "layers" and "containers" not in each
    )
    return [[name.strip().removeprefix("reseau.") for name in layer.split("|")] for layer in named]


def figure() -> Figure:
    """The layers as rows of boxes, with drivers and simulators beside them."""
    rows, width, height, gap = layers(), 8.4, 0.52, 0.16
    picture = Figure(figsize=(9.6, 0.5 + len(rows) * (height + gap)), layout="constrained")
    axes = picture.add_subplot()
    for k, row in enumerate(rows):
        y, each = -k * (height + gap), (width - gap * (len(row) - 1)) / len(row)
        for n, name in enumerate(row):
            _box(axes, n * (each + gap), y, each, height, name, ABOUT.get(name, ""), PALE)
    low, high = -(len(rows) - 1) * (height + gap), height
    names = [name for row in rows for name in row]
    own = next(k for k, row in enumerate(rows) if "instruments" in row)
    for n, (name, about) in enumerate(
        (
            ("drivers", "talk to hardware\n\nimport\ninstruments\ncore"),
            ("sims", "behave like it\n\nimport\noptics, designs\ninstruments\nio, core"),
        )
    ):
        x, bottom = width + 0.5 + 1.6 * n, -own * (height + gap)
        _box(axes, x, bottom, 1.4, high - bottom, f"reseau_{name}", about, "none")
        axes.annotate(
            "", (x + 0.7, low + height / 2), (x + 0.7, bottom),
            arrowprops={"arrowstyle": "-|>", "color": FAINT, "lw": 1.0},
        )  # fmt: skip
    axes.annotate(
        "a package imports only what is below it", (-0.25, low), (-0.25, high), rotation=90, ha="center",
        va="top", fontsize=9, color=INK, arrowprops={"arrowstyle": "-|>", "color": FAINT, "lw": 1.0},
    )  # fmt: skip
    axes.set(xlim=(-0.5, width + 3.7), ylim=(low - 0.1, high + 0.1))
    axes.axis("off")
    assert set(names) <= set(ABOUT), sorted(set(names) - set(ABOUT))
    return picture


def _box(
    axes: object, x: float, y: float, width: float, height: float, name: str, about: str, face: str
) -> None:
    style = "round,pad=0,rounding_size=0.06"
    box = FancyBboxPatch((x, y), width, height, boxstyle=style, facecolor=face, edgecolor=BLUE, linewidth=0.8)
    axes.add_patch(box)  # type: ignore[attr-defined]
    middle = y + height / 2
    axes.text(x + width / 2, middle + 0.09, name, ha="center", va="center", fontsize=10.5, weight="bold")  # type: ignore[attr-defined]
    axes.text(x + width / 2, middle - 0.04, about, ha="center", va="top", fontsize=8.5)  # type: ignore[attr-defined]


if __name__ == "__main__":
    with drawing():
        save(figure(), ROOT / "docs" / "images" / "layers.png")
