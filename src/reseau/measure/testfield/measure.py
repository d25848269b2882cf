"""A coded testfield in a frame: its lines found, its squares read, its targets measured.

The steps are those of Vosselman and Förstner (section 3): straight lines from the Laplacian by Hough and
adjustment, the targets of every square between them classified, the squares numbered by topology, and the
targets located by least-squares matching. What cannot be measured is reported so, with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code, Failure
from ...io import TestfieldDesign
from ...optics.formation import PixelResponse
from ..matching import Matches
from ..measured import Measured
from ..screening import quiet_noise, screen
from .clusters import Reading
from .lattice import LatticeFit, refit, slope_of
from .light import Light
from .sight import Sight
from .targets import Scene, match_targets, merged

__all__ = ["TestfieldOptions", "TestfieldResult", "measure_testfield"]

_LEAST_FIRST, _MOST_FIRST = 8, 36
"""How many large targets are matched first, to know the mapping and the sharpness better."""
_FEW, _AGAIN = 0.05, 4
"""Share of targets beyond the lines, or not measured, for which it is worth looking again; how often."""
_FAR = 4.5
"""Standard deviations that a target may be off where all targets together have it."""
_WIDE = 0.1
"""Part of the frame around it in which targets are looked for that reach into it."""
_BEYOND = 1.0
"""How far beyond the lines found, in steps of the lattice, the mapping through them still serves."""
_SETTLED_PX = 0.1
"""Changes of what the mapping predicts below which it need not be looked at farther out."""
_UNMODELLED_PX = 0.03
"""What positions scatter about a mapping of third degree beyond their own sigmas."""
_SEEN = 0.95
"""Share of a target that must lie on pixels that carry an image."""
_UNEASY = 1.4
"""Times the ordinary residuals from which on the ground is tried curved."""
_UNLIKE = 2.0
"""Times the ordinary residuals from which on an image is that of something else."""
_BLURRED, _PALE, _GROWN = 1.5, 0.25, 0.15
"""How sharpness, contrast and size of a target may differ from those of the others, as shares."""


@dataclass(frozen=True)
class TestfieldOptions:
    """How a testfield is measured.

    Parameters
    ----------
    psf_px : float
        First guess of the width (one sigma) of the point-spread function; estimated.
    row_jitter_px : float
        Standard deviation of the shift of single rows, where known.
    fill : float
        Light-sensitive part of the pitch of the pixels along either axis, 0 to 1, where known.
    least_t : float
        Least contrast of a target in units of its standard deviation.
    most_sigma_px : float
        Largest standard deviation of a coordinate that still counts as measured.
    neighbour_px : float
        Least deviation from the mapping through all targets for which one may be declined.
    """

    __test__ = False  # not one for pytest
    psf_px: float = 0.8
    row_jitter_px: float = 0.0
    fill: float = 1.0
    least_t: float = 8.0
    most_sigma_px: float = 0.3
    neighbour_px: float = 0.03


@dataclass(frozen=True, eq=False)
class TestfieldResult(Measured):
    """The targets of a testfield in one frame: `xy` are images of centroids, `deviation` from a mapping.

    Parameters
    ----------
    psf_px : ndarray (n,)
        Width of the point-spread function of each match, NaN where there was none.
    lattice : LatticeFit
        The straight lines as they were adjusted.
    reading : Reading
        What the clusters were taken for.
    squares : int
        Number of clusters that were read and agree.
    """

    __test__ = False  # not one for pytest, which collects what is named so
    psf_px: Array
    lattice: LatticeFit
    reading: Reading
    squares: int


def measure_testfield(
    frame: Frame, design: TestfieldDesign, options: TestfieldOptions | None = None
) -> TestfieldResult | Failure:
    """Measure every target of a coded testfield that can be measured.

    Parameters
    ----------
    frame : Frame
        A frame that shows the testfield or a part of it, at least one square with its lines.
    design : TestfieldDesign
        The testfield.
    options : TestfieldOptions, optional
        How.

    Returns
    -------
    TestfieldResult or Failure
        A failure (falsy) where the design is not to be found in the frame.

    Raises
    ------
    ImageError
        When the frame is all of one grey, or almost all saturated.
    UsageError
        When the design's squares have no sixteen targets in a grid.
    """
    options = options or TestfieldOptions()
    screened = screen(frame, None)
    grey = screened.grey if design.polarity == "dark" else -screened.grey
    noise = quiet_noise(grey)
    seen = Sight(screened.grey, grey, design, options.psf_px, PixelResponse(options.fill))
    read = seen.read()
    if isinstance(read, Failure):
        # Lines a pixel wide are lost in blur, but not for good.
        failure, sharp = replace(read, where=frame.name), seen.sharpened(noise)
        read = sharp.read()
        if isinstance(read, Failure):
            return failure
        seen = sharp
    if seen.another(read):
        return Failure(
            f"shows two testfields {design.name!r}; cut the picture so that it shows one",
            Code.SEVERAL_TARGETS,
            where=frame.name,
        )
    lattice, reading, placed = read.lattice, read.reading, read.placed
    valid = screened.valid & (frame.pixels < frame.full_scale)
    size = (float(frame.width), float(frame.height))
    light = Light.through(reading.xy.reshape(-1, 2), reading.level.ravel(), reading.contrast.ravel(), size)
    scene = Scene(
        screened.grey,
        valid,
        noise,
        design,
        lattice.mapping,
        placed.frame,
        placed.origin,
        light,
        seen.blurred(reading.psf_px),
        PixelResponse(options.fill),
        options.row_jitter_px,
    )
    return TestfieldResult(
        image=frame.name,
        sha256=frame.sha256,
        ids=design.ids,
        lattice=lattice,
        reading=reading,
        squares=placed.squares,
        **_Measurement(scene, lattice, options).columns(),
    )


class _Measurement:
    """The two rounds of matching, and the verdict on every target."""

    def __init__(self, scene: Scene, lattice: LatticeFit, options: TestfieldOptions) -> None:
        self.scene, self.options = scene, options
        self.at = scene.lattice(scene.design.xy)
        ends = np.array([(lines.min(), lines.max()) for lines in (lattice.across, lattice.along)])
        self.middle, self.half = ends.mean(axis=1), np.ptp(ends, axis=1) / 2
        self._place()

    def _place(self) -> None:
        """Where the mapping has the targets, and which of them are in the frame."""
        scene = self.scene
        self.predicted = scene.mapping(self.at)
        h, w = scene.grey.shape
        size = np.array([w, h])
        margin = 3 * scene.psf_px
        wide = _WIDE * size.max()
        self.rows = np.flatnonzero(((self.predicted > -wide) & (self.predicted < size + wide)).all(axis=1))
        self.rows = self.rows[self._unfolded(self.at[self.rows])]
        slope = slope_of(scene.mapping, self.at[self.rows]) @ scene.frame
        reach = np.abs(slope).sum(axis=2) * (np.array(scene.design.targets.size) * 0.6)[self.rows, None]
        xy = self.predicted[self.rows]
        near = ((xy > -reach - margin) & (xy < size - 1 + reach + margin)).all(axis=1)
        self.rows, reach, xy = self.rows[near], reach[near], xy[near]
        self.inside = ((xy > reach - 0.5) & (xy < size - 0.5 - reach)).all(axis=1)

    def _unfolded(self, at: Array) -> Mask:
        """Whether, from the middle of the lattice to these places, the mapping keeps its orientation.

        A polynomial folds back beyond the points that it was adjusted to.
        """
        way = at - self.middle
        parts = np.array([0.4, 0.7, 1.0])[:, None, None]
        slope = slope_of(self.scene.mapping, (self.middle + parts * way).reshape(-1, 2))
        unfolded: Mask = np.asarray((np.linalg.det(slope).reshape(3, -1) < 0).all(axis=0))
        return unfolded

    def columns(self) -> dict[str, Any]:
        """Columns of the result from `xy` to `noise`."""
        self._learn_outwards()
        wanted = self.rows[self.inside]
        found = self._matched()
        why, predicted = self._judged(self.scene, wanted, found)
        for _ in range(_AGAIN):
            good = why == ""
            if good.mean() > 1 - _FEW or good.sum() < _MOST_FIRST:
                break
            # Now that many are known, so is the mapping, and what neighbours take of the light.
            self._learn_from(found, good, wanted)
            wanted = self.rows[self.inside]
            found = self._matched()
            why, predicted = self._judged(self.scene, wanted, found)
            if (why == "").sum() < 1.05 * good.sum():
                break
        n = len(self.at)
        ok, reasons = np.zeros(n, dtype=bool), np.full(n, "beyond the edge of the frame", dtype=object)
        ok[wanted], reasons[wanted] = why == "", why

        def spread(values: Array, keep: Mask | slice = slice(None)) -> Array:
            full = np.full((n, *values.shape[1:]), np.nan)
            full[wanted[keep]] = values[keep]
            return full

        good = why == ""
        return {
            "xy": spread(found.xy, good),
            "cov": spread(found.cov, good),
            "ok": ok,
            "why": tuple(reasons),
            "predicted": predicted,
            "deviation": spread(found.xy - predicted[wanted], good),
        } | {name: spread(getattr(found, name)) for name in ("psf_px", "contrast", "t", "noise")}

    def _learn_outwards(self) -> None:
        """Learn mapping, light and sharpness from some of the large targets, matched first.

        It begins between the lines, where the mapping is known, and goes on outwards from there.
        """
        for beyond in (_BEYOND, np.inf):
            candidates = np.flatnonzero(self.inside & self.scene.design.large[self.rows])
            out = np.abs(self.at[self.rows[candidates]] - self.middle) - self.half
            candidates = candidates[(out <= beyond).all(axis=1)]
            if len(candidates) < _LEAST_FIRST:
                continue
            some = np.zeros(len(self.rows), dtype=bool)
            some[candidates[:: max(1, len(candidates) // _MOST_FIRST)]] = True
            predicted = self.predicted
            self._learn(some)
            moved = (self.predicted - predicted)[self.rows[self.inside]]
            if len(moved) and np.abs(moved).max() < _SETTLED_PX:
                break

    def _learn(self, some: Mask) -> None:
        for searching in (False, True):
            first = match_targets(self.scene, self.rows, some, searching=searching)
            sure = first.converged & (first.t > self.options.least_t) & (first.rejected < 0.1)
            if sure.sum() >= max(_LEAST_FIRST, some.sum() // 2):
                break
        if sure.sum() >= _LEAST_FIRST:
            self._learn_from(first, sure, self.rows[some])

    def _learn_from(self, first: Matches, sure: Mask, rows: Rows) -> None:
        """Mapping, light and sharpness from targets that were matched."""
        scene = self.scene
        mapping = refit(scene.mapping, self.at[rows[sure]], first.xy[sure], _UNMODELLED_PX)
        amplitude = first.contrast * (first.level if scene.design.polarity == "dark" else 1.0)
        light = Light.through(first.xy[sure], first.level[sure], amplitude[sure], scene.light.size)
        psf_px = float(np.median(first.psf_px[sure]))
        # What neighbours take of the light was not known well yet: the quieter ones tell the noise.
        noise = float(np.quantile(first.noise[sure], 0.2))
        self.scene = replace(scene, mapping=mapping, light=light, psf_px=psf_px, noise=noise)
        self._place()

    def _matched(self) -> Matches:
        """All targets matched; where the ground is uneven, with a curved one if that is better."""
        found = match_targets(self.scene, self.rows, self.inside)
        ordinary = np.median(found.noise[found.converged]) if found.converged.any() else np.inf
        uneasy = ~found.converged | (found.noise > _UNEASY * ordinary) | (found.rejected > 0.02)
        if not uneasy.any():
            return found
        some = self.inside.copy()
        some[some] = uneasy
        curved = match_targets(self.scene, self.rows, some, background=2)
        better = curved.converged & ~(curved.noise > 0.9 * found.noise[uneasy])
        keep = ~uneasy
        keep[uneasy] = ~better
        rows = [np.flatnonzero(keep), np.flatnonzero(~keep)]
        return merged(rows, [found.select(keep), curved.select(better)])

    def _judged(self, scene: Scene, wanted: Rows, found: Matches) -> tuple[Array, Array]:
        """Why each of the wanted targets is not measured, and where the mapping through all has them."""
        why = np.full(len(wanted), "", dtype=object)
        for mask, reason in self._objections(found):
            why[mask & (why == "")] = reason
        mapping, good = scene.mapping, why == ""
        if good.sum() >= _LEAST_FIRST:
            mapping = refit(mapping, self.at[wanted[good]], found.xy[good], _UNMODELLED_PX)
        predicted = mapping(self.at)
        off = np.hypot(*(found.xy - predicted[wanted]).T)
        # Half of the distances in a plane are below 1.18 standard deviations of a coordinate.
        ordinary = float(np.median(off[good])) / 1.18 if good.any() else 0.0
        sigma = np.sqrt(np.trace(found.cov, axis1=1, axis2=2) / 2)
        limit = np.maximum(self.options.neighbour_px, _FAR * np.hypot(ordinary, np.nan_to_num(sigma)))
        for k in np.flatnonzero(good & (off > limit)):
            why[k] = f"{off[k]:.2f} px off where all targets together have it"
        return why, predicted

    def _objections(self, found: Matches) -> list[tuple[Mask, str]]:
        """What speaks against a target in its own image, the gravest first."""
        o = self.options
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        sure = found.converged & (found.t > o.least_t)
        if not sure.any():
            return [(np.ones(len(found), dtype=bool), "no target stands out from its surroundings")]
        width, contrast, noise = (
            float(np.median(values[sure])) for values in (found.psf_px, found.contrast, found.noise)
        )
        return [
            (found.seen < _SEEN, "hidden, dazzled or beyond the edge of the frame"),
            (~found.converged, "the match does not converge"),
            (~(found.t >= o.least_t), "no target stands out from its surroundings"),
            (found.rejected > 0.1, "partly hidden"),
            (found.noise > _UNLIKE * noise, "the image is not that of the target"),
            (np.abs(np.log(found.psf_px / width)) > np.log(_BLURRED), "of another sharpness than the others"),
            (np.abs(found.contrast / contrast - 1) > _PALE, "of another contrast than the others"),
            (np.abs(found.form[:, 0]) > _GROWN, "of another size than the design has"),
            (~(sigma <= o.most_sigma_px), "too uncertain"),
        ]
