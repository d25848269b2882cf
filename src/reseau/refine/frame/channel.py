"""The four edges of a frame in one channel of a scan: which profiles agree, or why it is not found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .edges import Band, EdgeProfiles, measure_profiles, merged
from .lines import EdgeData, robust_line, shared_error

__all__ = ["FAR", "Channel", "channels_by_contrast", "measure_channel"]

_NEIGHBOURHOOD_PX = 0.05
"""What unevenness of the gate and the picture's own forms add to a profile's standard deviation at least."""
_TONE = 0.15
"""Standard deviation of the tone of film along an edge, over that of the noise of a pixel."""
_FEW_GOOD, FAR = 0.2, 2.5
"""Part of an edge's profiles that show a step, below which the edge is looked for so much further away."""
_MOST_GOOD = 0.85
"""Part of an edge's profiles that show a step, from which no wide ones are needed."""


@dataclass(frozen=True, eq=False)
class Channel:
    """One channel measured: of each edge the profiles kept, how many were not, why it was not found."""

    name: str
    data: list[EdgeData | None]
    rejected: list[int]
    why: list[str]


def channels_by_contrast(bands: Sequence[Band | None], count: int, reach: float) -> list[int]:
    """Channels by the contrast of the picture along the edges against the noise of film, the best first."""
    total = np.zeros(count)
    for band in bands:
        if band is None or count == 1:
            continue
        far = band.distance[::4] < -0.5 * reach
        near = band.distance[::4] > 0.5 * reach
        for c in range(count):
            grey = band.grey[::4, :, c]
            film, picture = grey[far & np.isfinite(grey)], grey[near & np.isfinite(grey)]
            if film.size and picture.size:
                noise = 0.5 + float(np.median(np.abs(film - np.median(film))))
                total[c] += abs(float(np.median(picture)) - float(np.median(film))) / noise
    return [int(c) for c in np.argsort(-total, kind="stable")]


def measure_channel(
    name: str,
    band: Callable[[int, bool, bool], Band | None],
    channel: int,
    polarity: int,
    reach: float,
    gap: float,
) -> Channel:
    """Profiles of the four edges in one channel, each edge's own line, and what agrees with it."""

    far = [False] * 4

    def measured(k: int, wide: bool, width: float | None = None) -> EdgeProfiles | None:
        pixels, reached = band(k, wide, far[k]), FAR * reach if far[k] else reach
        return None if pixels is None else measure_profiles(pixels, channel, polarity, reached, gap, width)

    profiles = [measured(k, False) for k in range(4)]
    for k, found in enumerate(profiles):
        if found is None or found.good.mean() < _FEW_GOOD:
            # What voted may have been a scratch beside the edge.
            far[k] = True
            again = measured(k, False)
            if again is not None and (found is None or again.good.mean() > found.good.mean()):
                profiles[k] = again
            else:
                far[k] = False
    widths = [p.width for p in profiles if p is not None and p.good.sum() > 20]
    if widths:
        # The spread of film and scanner is one for all edges.
        width = float(np.median(widths))
        for k, found in enumerate(profiles):
            if found is not None and abs(np.log(found.width / width)) > 0.12:
                found = measured(k, False, width) or found
            if found is not None and found.good.mean() < _MOST_GOOD:
                more = measured(k, True, width)
                found = found if more is None else merged(found, more)
            profiles[k] = found
    edges = [_edge(band(k, False, far[k]), found) for k, found in enumerate(profiles)]
    data, rejected, why = (list(column) for column in zip(*edges, strict=True))
    return Channel(name, data, rejected, why)


def _edge(band: Band | None, found: EdgeProfiles | None) -> tuple[EdgeData | None, int, str]:
    """The profiles of an edge that agree with its line; or why it is not found."""
    if band is None:
        return None, 0, "is not in the scan, or nothing parts it from the picture"
    if found is None:
        return None, 0, "no contrast between film and picture"
    place, offset, sigma = (part[found.good] for part in (found.place, found.offset, found.sigma))
    line = robust_line(place, offset, sigma, _NEIGHBOURHOOD_PX)
    rejected = int((~found.good).sum())
    if line is None:
        return None, rejected, f"only {len(place)} of {len(found.place)} profiles show a step"
    (start, stop, bow), agree = line
    if agree.sum() < max(12, 0.1 * len(found.place)) or agree.mean() < 0.45:
        return None, rejected, f"only {int(agree.sum())} of {len(found.place)} profiles agree with a line"
    if found.clean < 0.6:
        return None, rejected, "there is no unexposed film beyond it; do frames overlap?"
    residuals = (offset - (start * (1 - place) + stop * (1 + place)) / 2 + bow * (1 - place**2))[agree]
    total = np.hypot(sigma[agree], _NEIGHBOURHOOD_PX)
    scale = shared_error(place[agree], residuals, total)
    along = (band.stop - band.start) * ((place[agree] + 1) / 2)[:, None]
    xy = band.start + along + offset[agree][:, None] * band.normal
    # An error of the film's tone moves a step by √(2π) of its width for each part of the contrast.
    common = np.sqrt(2 * np.pi) * found.width * _TONE / found.contrast
    return EdgeData(xy, total * scale, float(common)), rejected + int((~agree).sum()), ""
