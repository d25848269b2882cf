"""Draws the pictures of docs/benchmarks/peers.md from the figures of the last `make bench`.

That of docs/scale.md is drawn from the tables there, whose networks take hours.

python docs/benchmark_figures.py
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from themes import save

from reseau.core.figures import ACCENT, BLUE, FAINT, INK, drawing

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import figures

DOCS = Path(__file__).resolve().parent
IMAGES = DOCS / "images"


def table(page: str, title: str) -> list[list[str]]:
    """Cells of the rows below the line of titles that contains some words."""
    lines = (DOCS / page).read_text().splitlines()
    (begin,) = (k for k, line in enumerate(lines) if line.startswith("|") and title in line)
    rows = []
    for line in lines[begin + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def numbers(cell: str) -> list[float]:
    """The numbers of a cell, such as both ends of a range; none of one without."""
    return [float(each) for each in re.findall(r"\d+(?:\.\d+)?", cell.replace(" ", ""))]


def bundle_size() -> Figure:
    """Processor time over the number of image points; hollow where a program stopped before the minimum."""
    figure = Figure(figsize=(8.4, 4.0), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    own, peers = table("scale.md", "| solved by |"), table("scale.md", "| Ceres | COLMAP |")
    rays = {row[0]: numbers(row[1])[0] for row in own}
    for axes, kind in zip(panels, ("Ladybug", "Venice"), strict=True):
        for label, rows, column, style in (
            ("reseau, with all statistics", own, 4, {"color": ACCENT, "marker": "o"}),
            ("reseau, to the minimum", own, 3, {"color": ACCENT, "marker": "o", "ls": ":"}),
            ("Ceres", peers, 2, {"color": BLUE, "marker": "s"}),
            ("COLMAP", peers, 3, {"color": INK, "marker": "^"}),
        ):
            mine = [row for row in rows if row[0].startswith(kind)]
            x, y = [rays[row[0]] for row in mine], [numbers(row[column])[0] for row in mine]
            axes.loglog(x, y, label=label, ms=5, **style)
            early = [k for k, row in enumerate(mine) if stopped_early(row[column])]
            axes.scatter([x[k] for k in early], [y[k] for k in early], s=140, marker=style["marker"],
                         facecolor="none", edgecolor=style["color"])  # fmt: skip
        axes.set_title(f"networks like {kind}", loc="left")
        axes.set_xlabel("image points")
        axes.grid(color=FAINT, alpha=0.3)
    panels[0].scatter(
        [], [], s=140, facecolor="none", edgecolor=INK, label="ended 1 % or more above the minimum"
    )
    panels[0].set_ylabel("processor time, s")
    # Below: lines cross the panels from one corner to the other.
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def stopped_early(cell: str) -> bool:
    """Whether the sum of squares in brackets is 1 % or more above the minimum."""
    above = re.search(r"\(\**([\d.]+(?:e-?\d+)?)", cell)
    return above is not None and float(above[1]) >= 0.01


def rows_of(table: str) -> dict[str, dict[str, figures.Figure]]:
    """The recorded figures of a table, by row and column."""
    rows: dict[str, dict[str, figures.Figure]] = {}
    for each in figures.recorded(table):
        rows.setdefault(each.row, {})[each.column] = each
    return rows


def beside_others() -> Figure:
    """Errors of image coordinates: ours, the bound, and those of other programs."""
    lines = [
        (row, cells, name)
        for row, cells in rows_of(figures.BOUND).items()
        for name in cells
        if name not in ("reseau", "bound")
    ]
    figure = Figure(figsize=(8.4, 0.34 * len(lines) + 1.1), layout="constrained")
    axes = figure.subplots()
    axes.set_xlim(0.0012, 8.0)
    for y, (_, cells, name) in enumerate(lines):
        for column, style in (
            ("reseau", {"marker": "o", "color": ACCENT, "s": 40, "zorder": 3}),
            ("bound", {"marker": "|", "color": INK, "s": 160, "zorder": 4}),
            (name, {"marker": "s", "color": BLUE, "s": 26, "zorder": 2}),
        ):
            if column in cells and cells[column].value is not None:
                axes.scatter(cells[column].value, y, **style)
        error = cells[name].value
        said = name if error is not None else f"{name}: not found"
        place = {"textcoords": "offset points", "va": "center", "fontsize": 8}
        axes.annotate(said, (error if error is not None else 0.05, y), (8, 0), **place)
    for label, marker, colour in (
        ("reseau", "o", ACCENT),
        ("Cramér–Rao bound", "|", INK),
        ("another program", "s", BLUE),
    ):
        axes.scatter([], [], marker=marker, color=colour, label=label)
    axes.set_xscale("log")
    axes.set_xlabel("rms error of a coordinate, px")
    labelled(axes, [row for row, _, _ in lines])
    axes.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def independent() -> Figure:
    """Errors over sigmas of the simulator's images and of independent ones."""
    known = rows_of(figures.ORIGIN)
    rows = {row: cells for row, cells in known.items() if any("sigmas" in column for column in cells)}
    figure = Figure(figsize=(8.4, 0.34 * len(rows) + 1.1), layout="constrained")
    axes = figure.subplots()
    axes.axvline(1.0, color=FAINT, lw=1)
    for k, cells in enumerate(rows.values()):
        for origin, colour, off, marker in (
            ("simulator", BLUE, -0.15, "s"),
            ("independent", ACCENT, 0.15, "o"),
        ):
            found = cells.get(f"{origin}, errors ÷ sigmas")
            if found is None or found.value is None:
                continue
            if found.low is not None and found.high is not None:
                axes.plot([found.low, found.high], [k + off] * 2, color=colour, lw=2)
            axes.plot(found.value, k + off, color=colour, marker=marker, ms=4)
    for label, colour, marker in (("simulator", BLUE, "s"), ("independent origin", ACCENT, "o")):
        axes.plot([], [], color=colour, lw=2, marker=marker, ms=4, label=label)
    axes.set_xlabel("errors ÷ sigmas; lines from the least to the greatest of conditions")
    axes.set_xlim(0, None)
    labelled(axes, list(rows))
    axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def labelled(axes: Axes, names: list[str]) -> None:
    """One line for each name, the first on top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(axis="x", color=FAINT, alpha=0.3)


def main() -> None:
    """Draw all."""
    pictures = {
        "bundle-size": bundle_size,
        "targets-beside-others": beside_others,
        "independent-beside-simulator": independent,
    }
    for name, picture in pictures.items():
        with drawing():
            save(picture(), IMAGES / f"{name}.png")


if __name__ == "__main__":
    main()
