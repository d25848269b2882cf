"""The four edges of a frame in one channel of a scan: consistent profiles, or the reason for a missing
edge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from ...core.data import Array, Mask
from .adjacent_lines import Softness, beside_edge, common_forms, normalised, soft_steps
from .border import Band, Border, Film
from .curves import CurveEvidence, probabilities_of
from .edges import EdgeProfiles, measure_profiles, merged
from .lines import Contender, EdgeData, Rival, bows_alike, departing_line, departures_of, mixed, robust_line
from .steps import Developed, StepForm, Tone

_NEIGHBOURHOOD_PX = 0.05
"""Minimum contribution of an uneven gate and of picture content to the sigma of a profile."""
_TONE = 0.12
"""Standard deviation of the tone of film along an edge relative to the noise of a pixel."""
_FEW_GOOD, WIDER_SEARCH = 0.2, 2.5
"""Minimum share of profiles that show a step; otherwise the edge is searched in a wider range, by this
factor."""
_FOREIGN = 0.08
"""Difference of the tone beyond an edge from film beyond the others, as a share of the picture's contrast,
from which it is no film."""
_UNEVEN = 0.45
"""Share of its own tone by which film may differ between edges, because the scanner's light is uneven."""
_TURNED, _ROUNDED, _MARGIN = 1.2, 0.25, 0.015
"""Sigmas by which neighbouring profiles lie inwards at a rounded corner, share of half an edge that the
corner may take, and additional margin."""
_LEAST_AGREE = 0.45
"""Minimum share of an edge's profiles that agree with a line."""
_BOWED, _OUTWARDS = 0.6, 0.1
"""Bow in pixels that picture content may cause; then the largest share of rejected profiles that lie
outwards of an edge without it."""
_BENT = 0.9
"""Share of profiles that agree with a line below which the others may be parts of the edge, which is bent."""
_WITHOUT_END, _BETTER, _AGREES, _CONTINUED = 0.3, 0.6, 5.0, 0.3
"""End of the part of an edge without the other end, which a dark structure may hide; misfit of this part
relative to that of the whole from which there is such a structure; standard deviations, times the misfit,
within which a profile agrees; and standard deviation of an end continued from this part, as a share of the
structure's distance."""
_PARTS, _MOST_PARTS = 20, 0.4
"""Parts of an edge, and share of them in which undisturbed profiles determine it."""
_MODEL_PX = 0.012
"""Standard deviation of the error of either end of an edge by the model of the step, which profiles share."""
_OTHER_WIDTH, _OTHER_LOBES = 0.12, 0.01
"""Differences in the logarithm of the width, and in the lobes, from which an edge is measured again with the
form of step common to the edges."""
_MOST_GOOD = 0.85
"""Share of profiles that show a step, from which wide profiles are not needed."""


@dataclass(frozen=True, eq=False)
class Channel:
    """Measured edges of one channel: profiles kept, number rejected, reason for a missing edge.

    Also the number of the channel, the polarity of the film, film and picture beside each edge, the width of
    a step, and what the edges show of the curve of the grey values if the file does not state it.
    """

    name: str
    number: int
    polarity: int
    borders: list[Border | None]
    width: float
    data: list[EdgeData | None]
    rejected: list[int]
    why: list[str]
    curves: CurveEvidence | None = None

    @property
    def shown(self) -> Array:
        """What each edge shows of the curves (e, k, 2); see :class:`EdgeData`."""
        return np.array([each.curves for each in self.data if each is not None])

    def doubted(self, other: Channel) -> Channel:
        """The channel with the doubts of one of more contrast: lines that may be hidden beside edges.

        Where both put an edge at the same place, both show the same, and less contrast does not show it
        better. A channel without the line shows the edge further outwards.
        """
        data = [
            own
            if own is None or doubtful is None or (doubtful.line - own.line)[:2].max() >= doubtful.doubt
            else own.doubted(doubtful.doubt)
            for own, doubtful in zip(self.data, other.data, strict=True)
        ]
        return replace(self, data=data)

    def contended(self, others: Sequence[Contender]) -> Channel:
        """The channel with edges that may be other lines."""
        data = list(self.data)
        for each in others:
            own = data[each.edge]
            if own is not None:
                moved = float(np.sqrt(each.probability) * np.hypot(each.inwards, each.sigma))
                rival = Rival("an edge of the frame elsewhere", each.probability, -each.inwards)
                data[each.edge] = replace(own.doubted(float(np.hypot(moved, own.doubt))), rival=rival)
        return replace(self, data=data)


def channels_by_contrast(bands: Sequence[Band | None], count: int, reach: float) -> list[int]:
    """Channels in order of the contrast of the picture along the edges relative to the noise of film."""
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
    forms: Sequence[Tone | Developed],
    share: Array | None = None,
) -> Channel:
    """Profiles of the four edges in one channel that agree with a line through each edge.

    Of several curves that the grey values may have, that is taken with which the edges are straight: the
    displacement of steps by another one depends on their contrast. Unless the probabilities `share` (k,) of
    the curves are known by other frames, too.
    """
    tones = np.array([isinstance(form, Tone) for form in forms])

    def measured(taken: int) -> Channel:
        return _measured(name, band, channel, polarity, reach, gap, forms, taken)

    found = measured(0)
    if len(forms) == 1 or not any(found.data):
        return found
    tried = {0: found}
    log = found.shown.sum(axis=0)[:, 0]
    own = probabilities_of(log)
    if np.argmax(own):
        # What a curve does to a step is computed for the measured one: neither of two curves is favoured.
        second = 1 + int(np.argmax((own * tones)[1:]))
        if any((other := measured(second)).data):
            tried[second] = other
            log = (log + other.shown.sum(axis=0)[:, 0]) / 2
            own = probabilities_of(log)
    share = own if share is None else share
    best = int(np.argmax(share))
    # A blur on the film is one of the light for the scanner.
    if tones[best]:
        found = tried[best] if best in tried else measured(best)
    found = found if any(found.data) else tried[0]
    moves = found.shown[..., 1].mean(axis=0)
    data = [edge and edge.curved(share) for edge in found.data]
    return replace(found, data=data, curves=CurveEvidence(log, share, moves - share @ moves))


def _measured(
    name: str,
    band: Callable[[int, bool, bool], Band | None],
    channel: int,
    polarity: int,
    reach: float,
    gap: float,
    forms: Sequence[Tone | Developed],
    taken: int,
) -> Channel:
    """The channel measured with one of the curves."""
    tone = forms[taken]
    assert isinstance(tone, Tone)
    pixels = [band(k, False, False) for k in range(4)]
    side = float(
        np.mean([np.hypot(*(each.stop - each.start)) for each in pixels if each is not None] or [1.0])
    )
    far: list[bool] = [False] * 4
    films: list[Film | None] = [None] * 4

    def measured(k: int, wide: bool, form: StepForm | None = None) -> EdgeProfiles | None:
        pixels, reached = band(k, wide, far[k]), WIDER_SEARCH * reach if far[k] else reach
        if pixels is None:
            return None
        return measure_profiles(pixels, channel, polarity, reached, gap, form, films[k], tone)

    profiles = [measured(k, False) for k in range(4)]
    for k, found in enumerate(profiles):
        if found is None or found.good.mean() < _FEW_GOOD:
            # The line that got the votes may have been a scratch beside the edge.
            far[k] = True
            again = measured(k, False)
            if again is not None and (found is None or again.good.mean() > found.good.mean()):
                profiles[k] = again
            else:
                far[k] = False
    for k, film in enumerate(_foreign(profiles)):
        if film is not None:
            films[k] = film
            profiles[k] = measured(k, False)
    for k, (found, form) in enumerate(zip(profiles, common_forms(profiles, side), strict=True)):
        if found is None or form is None:
            continue
        other = abs(np.log(found.width / form.width)) > _OTHER_WIDTH
        if other or abs(found.form.lobes - form.lobes) > _OTHER_LOBES:
            found = measured(k, False, form) or found
        if found.good.mean() < _MOST_GOOD:
            more = measured(k, True, form)
            found = found if more is None else merged(found, more)
        profiles[k] = found
    edges = [
        _edge(band(k, False, far[k]), found, soft, forms, taken)
        for k, (found, soft) in enumerate(zip(profiles, soft_steps(profiles, side), strict=True))
    ]
    bows = bows_alike([each.bows for each in edges])
    data = [edge.finished and edge.finished(own) for edge, own in zip(edges, bows, strict=True)]
    borders = [None if found is None else found.border for found in profiles]
    width = float(np.median([found.width for found in profiles if found is not None] or [1.0]))
    rejected, why = [each.rejected for each in edges], [each.why for each in edges]
    return Channel(name, channel, polarity, borders, width, data, rejected, why)


def _foreign(profiles: Sequence[EdgeProfiles | None]) -> list[Film | None]:
    """Film of the other edges, for edges beyond which there is something else."""
    seen = [p for p in profiles if p is not None]
    if len(seen) < 2:
        return [None] * len(profiles)
    # Film is darker than anything else; the second darkest of the edges is robust.
    film = sorted((p.border.film for p in seen), key=lambda f: f.tone)[1]
    contrast = max(p.border.contrast for p in seen if p.border.film.tone <= film.tone)
    most = _FOREIGN * contrast + _UNEVEN * abs(film.tone)
    return [film if p is None or p.border.film.tone - film.tone > most else None for p in profiles]


class _Edge(NamedTuple):
    """An edge before the bows of all are compared: why it is missing, and the number of rejected profiles.

    If it is found, the logarithm (b,) of the likelihood of each size of bows, and the edge as a function of
    the logarithms of their probabilities.
    """

    why: str
    rejected: int = 0
    bows: Array | None = None
    finished: Callable[[Array], EdgeData] | None = None


def _edge(
    band: Band | None,
    found: EdgeProfiles | None,
    soft: Softness,
    forms: Sequence[Tone | Developed],
    taken: int,
) -> _Edge:
    """Profiles of an edge that agree with its line, or the reason why it is not found."""
    if band is None:
        return _Edge("is not in the scan, or nothing separates it from the picture")
    if found is None:
        return _Edge("no contrast between film and picture")
    around = beside_edge(found, soft, float(np.hypot(*(band.stop - band.start))))
    beside, moved = around.share[found.good], around.moved.T[found.good]
    drawn, of_line = around.scatter[:, found.good]
    place, offset, own = (part[found.good] for part in (found.place, found.offset, found.sigma))
    sigma, offset = np.hypot(own, drawn), offset - moved[:, 0]
    line = _line(place, offset, sigma, own)
    rejected = int((~found.good).sum())
    if line is None:
        return _Edge(f"no line fits {len(place)} of {len(found.place)} profiles that show a step", rejected)
    near, agree, doubt = line
    if agree.sum() < max(12, 0.1 * len(found.place)) or agree.mean() < _LEAST_AGREE:
        return _Edge(f"only {int(agree.sum())} of {len(found.place)} profiles agree with a line", rejected)
    border = found.border
    if border.clean < 0.6:
        return _Edge("there is no unexposed film beyond it; frames may overlap", rejected)
    # An error of the film's tone moves a step by √(2π) of its width, times the error relative to the
    # contrast.
    common = float(np.sqrt(2 * np.pi) * found.width * _TONE * border.noise / border.contrast)
    if _spans(place[beside < 0.5]):
        # The edge is seen by itself beside the structures that displace some of its steps.
        agree &= beside < 0.5
    residuals = _inward(near, place, offset)
    agree &= _straight(place, residuals / np.hypot(sigma, _NEIGHBOURHOOD_PX))
    # A structure of the picture lies inwards of the edge; parts of an edge that is bent lie on both sides.
    used = agree | (agree.mean() < _BENT and not _only_inwards(residuals, line[1]))
    harmonics = band.harmonics(place, offset - residuals)
    curved = _curved(found, forms, taken)[found.good]
    steps = place[used], offset[used], own[used], harmonics[used]
    parts = departing_line(*steps, drawn[used], np.insert(curved[used], 0, 0.0, axis=1), hidden=True)
    lines = departing_line(*steps, of_line[used], (moved[:, 1:] - moved[:, :1])[used])
    log = around.log + np.concatenate([parts.log[:, :1], lines.log], axis=1)
    ends = np.concatenate([parts.values[:, :1], lines.values], axis=1)
    covariances = np.concatenate([parts.covariance[:, :1], lines.covariance], axis=1)

    def finished(bows: Array) -> EdgeData:
        """The edge, with the probabilities of the sizes of bows as logarithms (b,)."""
        each = (log + bows[:, None]).ravel()
        share = normalised(each)[1]
        values, covariance = mixed(share, ends.reshape(-1, 3), covariances.reshape(-1, 3, 3))
        by_line = share.reshape(log.shape)
        lined = float(by_line[:, 1:].sum())

        def middle(some: slice) -> Array:
            total = by_line[:, some].sum()
            return np.tensordot(by_line[:, some], ends[:, some], 2) / total if total > 0 else values

        moved_by = (middle(slice(1, None)) - middle(slice(1)))[:2]
        # With a line beside it, the edge says nothing about the curve.
        of_curves = scipy.special.logsumexp(parts.log + bows[:, None], axis=0)
        likelihood = np.log(lined + (1 - lined) * np.exp(np.minimum(of_curves[1:] - of_curves[0], 600.0)))
        # Steps that are too sharp belong to a scratch and are equally uninformative.
        square = doubt**2 + soft.sharpened * soft.width**2
        covariance[:2, :2] += common**2 + (_MODEL_PX**2 + square) * np.eye(2)
        rest = _inward(values, place[used], offset[used])
        return EdgeData(
            values,
            covariance,
            band.at(place[used], offset[used]),
            rest,
            departures_of(place[used], rest, own[used]),
            float(np.sqrt(square + share @ ((ends.reshape(-1, 3) - values) ** 2)[:, :2].mean(axis=1))),
            _rival(beside, moved[:, 0], lined, moved_by),
            np.stack([likelihood, -np.median(curved[used], axis=0)], axis=1),
        )

    bows = np.asarray(scipy.special.logsumexp(log, axis=1))
    return _Edge("", rejected + int((~used).sum()), bows, finished)


def _curved(found: EdgeProfiles, forms: Sequence[Tone | Developed], taken: int) -> Array:
    """Displacements inwards (n, k) of steps measured with the taken curve, where another one is true."""
    level = np.full(len(found.place), float(np.median(found.border.level)))
    away, shown = np.array([each.displaced(level, found.contrast) for each in forms]).transpose(1, 2, 0)
    # The light is spread alike, whatever the contrast.
    width = found.width * np.median(shown[:, taken, None] / shown, axis=0)
    return np.asarray(width * away - found.width * away[:, taken, None])


def _rival(beside: Array, moves: Array, lined: float, moved: Array) -> Rival:
    """The line of the picture that is most probably beside an edge, or beside parts of it.

    `beside` and `moves` are probabilities of a second step and displacements by it, `lined` the probability
    of a line beside all of the edge, which moves its ends by `moved`.
    """
    if (beside > 0.5).any() and lined < min(0.5, beside.max()):
        where = f"a line of the picture beside {np.mean(beside > 0.5):.0%} of it"
        return Rival(where, float(beside.max()), -float(np.abs(moves[beside > 0.5]).max()))
    return Rival("a line of the picture beside it", lined, float(moved[np.abs(moved).argmax()]))


def _spans(place: Array) -> bool:
    """Whether profiles at these positions are seen along enough of an edge, and towards both of its ends.

    A line beside one half hides an edge there; continued from the other half, it was wrong by 1 px.
    """
    seen = np.bincount(((place + 1) / 2 * _PARTS).astype(np.intp).clip(0, _PARTS - 1), minlength=_PARTS) > 2
    third = _PARTS // 3
    return bool(seen.mean() > _MOST_PARTS and seen[:third].any() and seen[-third:].any())


def _line(place: Array, offset: Array, sigma: Array, own: Array) -> tuple[Array, Mask, float] | None:
    """Chord and bow of an edge, the profiles that agree, and the sigma of an end that it continues.

    `own` sigmas exclude displacement by lines.

    A structure in the picture that bends away from a dark edge, or is as dark as film along one end of it,
    must not appear as a bow: the profiles that disagree with the edge without it all lie inwards.
    """
    found = robust_line(place, offset, sigma, _NEIGHBOURHOOD_PX)
    if found is None:
        return None
    if abs(found[0][2]) < _BOWED:
        return *found, 0.0
    if found[0][2] < 0:
        other = robust_line(place, offset, own, _NEIGHBOURHOOD_PX, bow=_BOWED / 3)
        if other is not None and _only_inwards(_inward(other[0], place, offset), other[1]):
            return *other, 0.0
        return *found, 0.0
    total = np.hypot(sigma, _NEIGHBOURHOOD_PX)
    best, doubt, least = found, 0.0, _BETTER * _misfit(found, place, offset, total)
    for end in (-1.0, 1.0):
        part = place * end < _WITHOUT_END
        other = robust_line(place[part], offset[part], sigma[part], _NEIGHBOURHOOD_PX)
        if other is None:
            continue
        misfit = _misfit(other, place[part], offset[part], total[part])
        inward = _inward(other[0], place, offset)
        agree = np.abs(inward) < _AGREES * misfit * total
        # A real bow fits all profiles as well as those without one end.
        if misfit < least and _only_inwards(inward, agree):
            best, least = (other[0], agree), misfit
            doubt = _CONTINUED * float(np.abs(other[0][:2] - found[0][:2]).max())
    return *best, doubt


def _misfit(line: tuple[Array, Mask], place: Array, offset: Array, total: Array) -> float:
    """Factor on the standard deviations of the profiles that agree with a line."""
    values, agree = line
    rest = (_inward(values, place, offset) / total)[agree]
    return float(np.sqrt(max(float(np.mean(rest**2)), 1.0)))


def _inward(line: Array, place: Array, offset: Array) -> Array:
    """Distances of profiles from a line [start, stop, bow], positive inwards."""
    return np.asarray(offset - (line[0] * (1 - place) + line[1] * (1 + place)) / 2 + line[2] * (1 - place**2))


def _only_inwards(inward: Array, agree: Mask) -> bool:
    """Whether most profiles agree with a line, and nearly all others lie inwards of it."""
    outside = np.count_nonzero(inward[~agree] < 0)
    return bool(agree.mean() > _LEAST_AGREE and outside < _OUTWARDS * np.count_nonzero(~agree))


def _straight(place: Array, inward: Array) -> Mask:
    """Mask of profiles outside rounded corners, where the edge turns inwards significantly."""
    turned = scipy.ndimage.median_filter(inward, size=min(9, len(inward)), mode="nearest") > _TURNED
    keep = np.ones(len(place), dtype=bool)
    for order in (np.arange(len(place)), np.arange(len(place))[::-1]):
        straight = np.flatnonzero(~turned[order])
        begin = place[order[straight[0]]] if len(straight) else 0.0
        if len(straight) and straight[0] > 0 and abs(begin) > 1 - _ROUNDED:
            keep &= np.abs(place - place[order[0]]) > abs(begin - place[order[0]]) + _MARGIN
    return keep
