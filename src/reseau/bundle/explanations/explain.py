"""What is wrong in an adjusted network, if anything: explanations compete for the same image points.

Each explanation displaces the image points by effects that the adjustment did not know of; see
:mod:`reseau.bundle.diagnostics.evidence`. They are compared by the density of the image points, which is the
product of those with which each is predicted by the others before it; a prior probability of one in a hundred
that anything is wrong, shared by all, says how much better than chance an explanation must predict. The
best is taken into account, and what is left is looked at again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from ...calibration import Cause
from ...calibration.camera import by_rotation, places, projection_slopes, referred
from ...core.data import Array, Rows
from ...core.failure import Failure
from ...core.threads import one_thread
from ..diagnostics.evidence import Scores, scores, too_large, used_rows
from ..diagnostics.fields import camera_mapping
from ..diagnostics.result import Result
from .alternatives import alternatives, divided
from .discrete import Single, gross_errors, other_cameras
from .effects import Family, Sight, creased, families, lens_at
from .names import Misnamed
from .sentences import advice, listed_places

_FALSE = 0.01
"""Probability that something is wrong, before the observations are seen. By Markov's inequality sound
networks are called wrong no more often than this by Bayes factors against their being sound."""
_KNOWN = 1 - _FALSE
"""Probability that the standard deviations of the image points are right, whatever else is wrong."""
_LACKS = 0.1
"""Probability that a lens has what its model lacks, before observations are seen, for errors in the corners:
there it is a doubt, not a finding."""
_CAUSES = 3
"""Causes that are named at most."""
_ROUNDS, _SMALL = 4, 0.01
"""Adjustments with the effects of a cause, at most, and the relative change of these that is none."""
_RATIOS = (0.25, 1.0, 4.0)
"""Ratios of the displacements by two kinds of effects."""
_PROMISING = 0.5
"""Part of what the best cause explains from which others are adjusted, too."""
_ALIKE = 0.05
"""Probability from which another explanation is named, too."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """The explanations of an adjusted network.

    Parameters
    ----------
    causes : tuple of Cause
        The most probable first, then others that explain alike, then what explains the rest; empty where the
        network is sound.
    log_evidence : mapping of str to float
        By code: logarithm of the density of the image points by that if all is right.
    forms : mapping of str to float
        The same for each form of each cause.

    Examples
    --------
    >>> Explanation((Cause("noise", "1.3 times", 0.01, 0.0, 1.0),), {}, {}).sound
    True
    """

    causes: tuple[Cause, ...]
    log_evidence: Mapping[str, float]
    forms: Mapping[str, float]
    _errors: tuple[_Error, ...] = field(default=(), repr=False)
    _result: Result | None = field(default=None, repr=False)

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong, but perhaps the standard deviations of the image points."""
        return all(cause.code == "noise" for cause in self.causes)

    def projection_variance(self, c: int, across: int) -> Array:
        """Mean squares of errors of the projection over the image by what is wrong, or could be.

        Parameters
        ----------
        c : int
            Row of the camera.
        across : int
            Places along the longer side.

        Returns
        -------
        ndarray (rows, columns, 2, 2)
            px²; after the rotation that fits best over the image. What the model of the lens lacks counts as
            much as it is probable; coefficients that were not estimated could be there.
        """
        if self._result is None:
            return np.zeros((1, 1, 2, 2))
        lens = camera_mapping(self._result, c, formal=True)
        xy, shape = places(lens, across, None)
        slope, _ = projection_slopes(lens, xy)
        uv = lens.mapping.inverse(xy)
        known = np.isfinite(uv).all(axis=1)
        turn = np.full((len(xy), 2, 3), np.nan)
        turn[known] = lens.mapping.derivatives(uv[known]).d_xy @ by_rotation(uv[known], lens.mapping.parallel)
        _, columns, _ = self._result.camera_columns(c)
        total = np.zeros((len(xy), 2, 2))
        for error in self._errors:
            by = -slope @ error.form.scores.carried[columns]
            own = error.at(c, xy)
            if own is not None:
                by[known] += referred(turn[known], own[known])
            mean = by @ error.effects
            total += error.weight * (
                mean[:, :, None] * mean[:, None, :] + by @ error.covariance @ np.swapaxes(by, 1, 2)
            )
        return total.reshape(*shape, 2, 2)


@dataclass(frozen=True, eq=False)
class _Form:
    """One form of a cause: its family, columns in their units, scores and evidence.

    Where it was adjusted: what it leaves, the scores of its family without it, and its effects.
    """

    family: Family
    name: str
    columns: Rows
    units: Array | None
    scores: Scores
    log_evidence: float
    adjusted: tuple[Sight, Scores, Array] | None = None

    @property
    def code(self) -> str:
        return self.family.code

    @property
    def size(self) -> float:
        return self.scores.best_size()


@dataclass(frozen=True, eq=False)
class _Error:
    """Effects of a form, which may be there with the probability `weight`."""

    form: _Form
    effects: Array
    covariance: Array
    weight: float
    sight: Sight

    def at(self, c: int, xy: Array) -> Array | None:
        """Displacements of the projection at places of the image by the effects of a lens (g, 2, k)."""
        if self.form.code != "lens":
            return None
        slope = lens_at(self.sight, self.form.family, c, xy)
        q = slope.shape[2]
        found = np.zeros((len(xy), 2, len(self.form.columns)))
        own = np.flatnonzero(self.form.columns // q == c)
        found[:, :, own] = slope[:, :, self.form.columns[own] % q]
        assert self.form.units is not None
        return found * self.form.units


@one_thread()
def explain(result: Result, misnamed: Misnamed | None = None) -> Explanation:
    """Find what is wrong in an adjusted network.

    Parameters
    ----------
    result : Result
        The adjustment.
    misnamed : Misnamed, optional
        Image points that were left out before it; see :func:`misnamed`.

    Returns
    -------
    Explanation
        Without causes where the network is sound, and where it is too large to be looked at.

    Notes
    -----
    See ``docs/mathematics/explanations.md``.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> explain(adjust_network(example_network())).causes
    ()
    """
    before = [] if misnamed is None else [_of_names(misnamed, result)]
    if not result.fit.cofactors.reduced.known or result.redundancy < 1 or not result.fit.cost > 0:
        return Explanation(tuple(before), {}, {})
    sight = Sight(result)
    every: Sequence[Family] = list(families(sight))
    if too_large(result.fit, sum(family.effect.count for family in every)):
        return Explanation(tuple(before), {}, {})
    whole = scores(result.fit, [family.effect for family in every])
    first, log_evidence, causes = whole, dict[str, float](), list[Cause]()
    forms: list[_Form] = []
    errors: list[_Error] = []
    taken = set[str]()
    for step in range(_CAUSES):
        now = _compared(whole, every, sight, taken, discrete=step == 0)
        if step == 0:
            log_evidence, forms = now.log_evidence, now.forms
            errors += _possible(now, sight)
        found = now.causes(first, sight)
        if not found:
            break
        if found[0].code == "unknown":
            named = _named_besides(now, whole, every, sight)
            if named is not None:
                found = [now.cause(named, found[0].probability, first, sight)]
        causes += found
        best = now.best_form(found[0].code)
        alone = found[0].code in ("noise", "unknown") or found[0].code in now.single
        if alone or best is None or best.units is None:
            break
        if step or found[0].code != "lens":
            errors.append(_error(best, 1.0, sight))
        taken.add(found[0].code)
        whole, every, sight = _after(best, whole, every, sight)
    if misnamed is not None:
        # What else deviates in these images has perhaps the same cause.
        alike = all(cause.code in ("noise", "blunders", "unknown") for cause in causes)
        causes = [*before, *causes] if alike else [*causes, *before]
    each = dict[str, float]()
    for form in forms:
        name = f"{form.code}: {form.name}"
        each[name] = max(form.log_evidence, each.get(name, -np.inf))
    return Explanation(tuple(causes), log_evidence, each, tuple(errors), result)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Explanations by code, with their evidence against nothing wrong."""

    log_evidence: dict[str, float]
    forms: list[_Form]
    single: dict[str, Single]

    def best_form(self, code: str) -> _Form | None:
        """The best form of a cause."""
        own = [form for form in self.forms if form.code == code]
        return max(own, key=lambda form: form.log_evidence, default=None)

    def causes(self, first: Scores, sight: Sight) -> list[Cause]:
        """The best explanation, and those that explain alike; none where nothing is wrong."""
        prior = np.log(_FALSE / len(self.log_evidence))
        weights = {"": np.log1p(-_FALSE)}
        weights |= {code: value + prior for code, value in self.log_evidence.items()}
        weights["noise"] = self.log_evidence["noise"] + np.log(_FALSE)
        total = float(scipy.special.logsumexp(list(weights.values())))
        share = {code: float(np.exp(weight - total)) for code, weight in weights.items()}
        order = sorted(share, key=lambda code: -share[code])
        if not order[0]:
            return []
        found = [self.cause(order[0], share[order[0]], first, sight)]
        if order[0] not in ("noise", "unknown"):
            alike = [code for code in order[1:] if code not in ("", "noise", "unknown")]
            others = [self.cause(code, share[code], first, sight) for code in alike if share[code] > _ALIKE]
            found += [replace(cause, instead=True) for cause in others]
        return found

    def cause(self, code: str, probability: float, first: Scores, sight: Sight) -> Cause:
        """What a cause explains, and where."""
        single, form, sigma = self.single.get(code), self.best_form(code), sight.typical
        if single is not None:
            explained, name, where = single.explained, single.form, _where(code, single.rows, sight)
        elif form is not None:
            explained, name = form.scores.explained(form.size), form.name
            where = _images(form, sight)
        else:
            factor = np.sqrt(first.square / first.redundancy)
            return Cause("noise", f"{factor:.2g} times", sigma * abs(factor - 1), 0.0, probability, "",
                         advice("noise", f"{factor:.2g}"))  # fmt: skip
        amount = sigma * np.sqrt(max(explained, 0.0) / (2 * len(sight.rows)))
        return Cause(code, name, amount, min(explained / first.square, 1.0), probability, where,
                     advice(code, name, sight.result.rivals is not None))  # fmt: skip


def _compared(
    whole: Scores, every: Sequence[Family], sight: Sight, taken: set[str], *, discrete: bool
) -> _Comparison:
    """Compare all explanations of what is left."""
    forms, parts = list[_Form](), {}
    for family in every:
        if family.code in taken:
            continue
        part = whole.part(_columns(family, every))
        parts[family.code] = part
        forms += _forms(family, part, sight)
    forms = _nearer(forms, sight, whole) if discrete else forms
    sound = whole.log_nothing(known=1.0)
    found = {"noise": whole.log_nothing(known=0.0) - sound}
    for code in dict.fromkeys(form.code for form in forms):
        each = [form.log_evidence for form in forms if form.code == code]
        found[code] = float(scipy.special.logsumexp(each)) - np.log(len(each)) - sound
    forms = [replace(form, log_evidence=form.log_evidence - sound) for form in forms]
    single: dict[str, Single] = {}
    if discrete:
        refocused = [form.adjusted for form in forms if form.code == "refocus" and form.adjusted is not None]
        near = refocused[0][:2] if refocused else (sight, parts.get("refocus"))
        others = [gross_errors(sight, _KNOWN)]
        others += [] if near[1] is None else [other_cameras(near[0], near[1], _KNOWN)]
        single = {one.code: one for one in others if one is not None}
        if (camera := single.get("other-camera")) and camera.log_evidence - sound > -np.log(_FALSE):
            single["other-camera"] = divided(sight.result, camera, _KNOWN)
        found |= {code: one.log_evidence - sound for code, one in single.items()}
    if discrete and max(found.values()) > -np.log(_FALSE) and max(found, key=found.__getitem__) != "noise":
        # Where the model was chosen, the richer ones have been compared.
        richer = alternatives(sight.result, _KNOWN) if sight.result.rivals is None else ()
        for one in (*richer, *_of_creases(sight)):
            if one.log_evidence - sound > found.get(one.code, -np.inf):
                found[one.code] = one.log_evidence - sound
                single[one.code] = one
    return _Comparison(found, forms, single)


def _of_creases(sight: Sight) -> Iterator[Single]:
    """Yield what differs over the target from image to image, which has many effects."""
    for family in creased(sight):
        if too_large(sight.result.fit, family.effect.count):
            continue
        forms = _forms(family, scores(sight.result.fit, [family.effect]), sight)
        log = float(scipy.special.logsumexp([form.log_evidence for form in forms])) - np.log(len(forms))
        best = max(forms, key=lambda form: form.log_evidence)
        yield Single(best.code, best.name, log, best.scores.explained(best.size))


def _nearer(forms: list[_Form], sight: Sight, whole: Scores) -> list[_Form]:
    """The forms, of which the best of each promising cause is adjusted."""
    nothing = max(whole.log_nothing(known=0.0), whole.log_nothing(known=1.0))
    most = max((form.log_evidence for form in forms if form.units is not None), default=nothing)
    if most < nothing - np.log(_FALSE):
        return forms
    found = list(forms)
    for family in dict.fromkeys(form.family for form in forms if form.units is not None):
        own = [k for k, form in enumerate(forms) if form.family is family]
        k = max(own, key=lambda k: forms[k].log_evidence)
        if forms[k].log_evidence - nothing > _PROMISING * (most - nothing):
            found[k] = _adjusted_with(forms[k], sight)
    return found


def _named_besides(now: _Comparison, whole: Scores, every: Sequence[Family], sight: Sight) -> str | None:
    """The cause that, with smooth fields of what it leaves, predicts better than these fields alone."""
    alone = max(form.log_evidence for form in now.forms if form.code == "unknown")
    sound, best = whole.log_nothing(known=1.0), (alone - np.log(_FALSE / len(now.log_evidence)), "")
    for code in dict.fromkeys(form.code for form in now.forms):
        form = now.best_form(code)
        if code == "unknown" or form is None or form.units is None:
            continue
        left, others, seen = _after(form, whole, every, sight, only="unknown")
        for family in others:
            if family.code == "unknown":
                part = left.part(_columns(family, others))
                both = max(each.log_evidence for each in _forms(family, part, seen)) - sound
                best = max(best, (both, code))
    return best[1] or None


def _after(
    form: _Form, whole: Scores, every: Sequence[Family], sight: Sight, only: str = ""
) -> tuple[Scores, Sequence[Family], Sight]:
    """Scores of the causes, or of one of them, after the effects of a form were taken into account."""
    assert form.units is not None
    if form.adjusted is not None:
        sight, _, effects = form.adjusted
        every = [form.family, *families(sight, only)]
        whole = scores(sight.result.fit, [family.effect for family in every])
        whole = whole.before(np.concatenate([effects, np.zeros(len(whole.g) - len(effects))]))
    begin = _columns(form.family, every).start
    return whole.with_effects(begin + form.columns, form.size * form.units), every, sight


def _columns(family: Family, every: Sequence[Family]) -> slice:
    """The columns of a family among those of all."""
    k = next(k for k, one in enumerate(every) if one is family)
    begin = sum(one.effect.count for one in every[:k])
    return slice(begin, begin + family.effect.count)


def _forms(family: Family, part: Scores, sight: Sight) -> list[_Form]:
    """The forms of a cause."""
    effect = family.effect
    groups, q = effect.groups, effect.slope.shape[2]
    total = effect.mean_square(sight.sigma)
    # Effects of one kind have one standard deviation in all groups; kinds displace image points alike, or two
    # of them by some ratio.
    alike = np.arange(q) if family.alike is None else family.alike
    of_kind = np.array([total[alike == kind].sum() for kind in alike])
    unit = np.where(of_kind > 0, 1.0 / np.sqrt(np.where(of_kind > 0, of_kind, 1.0)), 0.0)
    found = []
    for name, chosen in family.forms.items():
        if chosen.ndim > 1:
            own = part.combined(groups, np.asarray(sight.typical * chosen, dtype=np.float64))
            columns = np.arange(groups * q)
            found.append(_Form(family, name, columns, None, own, own.log_evidence(known=_KNOWN)))
            continue
        kinds = np.unique(alike[chosen])
        columns = (np.arange(groups)[:, None] * q + chosen).ravel()
        for ratio in _RATIOS if len(kinds) == 2 else (1.0,):
            each = unit[chosen] * np.where(alike[chosen] == kinds[0], ratio, 1.0)
            rms = np.sqrt((each**2 * total[chosen]).sum())
            units = np.tile(each / (rms if rms > 0 else 1.0), groups)
            own = part.part(columns).scaled(units)
            found.append(_Form(family, name, columns, units, own, own.log_evidence(known=_KNOWN)))
    return found


def _adjusted_with(form: _Form, sight: Sight) -> _Form:
    """The form as an adjustment with its effects finds it; as it was where none is better.

    What large effects do to image points is not linear in them: they are taken out of the coordinates of the
    image points, or added to those of the object points, and the adjustment is repeated from there.
    """
    network, fit, size, units = sight.network, sight.result.fit, form.size, form.units
    assert units is not None
    problem, seen, family = fit.problem.continued(fit), sight, form.family
    effects, best = form.scores.effects(size), form
    for _ in range(_ROUNDS):
        every = np.zeros(family.effect.count)
        every[form.columns] = units * effects
        if family.moves is not None:
            xyz = fit.values.xyz + family.moves @ every
            moved = replace(network, xyz=xyz)
            problem = replace(problem, network=moved, start=replace(problem.start, xyz=xyz))
        else:
            xy = network.xy.copy()
            by_group = every.reshape(family.effect.groups, -1)[family.effect.group]
            xy[seen.rows] -= (family.effect.slope @ by_group[:, :, None])[:, :, 0]
            moved = replace(network, xy=xy)
            problem = replace(problem, network=moved)
        again = replace(problem, rounds=0).adjusted()
        if isinstance(again, Failure) or len(used_rows(again)) != len(seen.rows):
            return best
        seen = Sight(Result(moved, again, sight.result.rejected))
        family = family.seen_again(seen)
        part = scores(again, [family.effect]).before(every)
        own = part.part(form.columns).scaled(units)
        log = own.log_evidence(known=_KNOWN)
        if log > best.log_evidence:
            best = replace(form, family=family, log_evidence=log, adjusted=(seen, part, every))
        step = own.effects(size) - effects
        effects = effects + step
        if np.linalg.norm(step) < _SMALL * np.linalg.norm(effects):
            break
        problem = problem.continued(again)
    return best


def _possible(now: _Comparison, sight: Sight) -> list[_Error]:
    """What the lens could have that its model lacks: each form as probable as it is."""
    # Coefficients that the covariance of the cameras contains are not counted twice.
    known = ("coefficients",) if sight.result.rivals is not None else ()
    lens = [
        form for form in now.forms
        if form.code == "lens" and form.units is not None and form.family.kind not in known
    ]  # fmt: skip
    if not lens:
        return []
    prior = np.log(_LACKS / (1 - _LACKS) / len(lens))
    log = np.array([0.0, *(form.log_evidence + prior for form in lens)])
    share = np.exp(log - scipy.special.logsumexp(log))[1:]
    return [
        _error(form, float(weight), sight) for form, weight in zip(lens, share, strict=True) if weight > 1e-3
    ]


def _error(form: _Form, weight: float, sight: Sight) -> _Error:
    """The effects of a form of its best size, and their covariance."""
    size = form.size
    inverse: Array = np.asarray(
        np.linalg.inv(form.scores.m + np.eye(len(form.scores.g)) / size**2), dtype=np.float64
    )
    left = form.scores.square - form.scores.explained(size)
    variance = max(left / form.scores.redundancy, 0.0)
    return _Error(form, inverse @ form.scores.g, variance * inverse, weight, sight)


def _where(code: str, rows: Rows, sight: Sight) -> str:
    """Image points, or images, that were chosen."""
    network = sight.network
    if not len(rows):
        return ""
    if code == "other-camera":
        return listed_places([network.images[i] for i in rows], "image")
    at = sight.rows[rows]
    names = [f"{network.points[network.point_of[k]]} in {network.images[network.image_of[k]]}" for k in at]
    return listed_places(names, "point")


def _images(form: _Form, sight: Sight) -> str:
    """The images that an effect of each image concerns most; empty where it is of all."""
    effect = form.family.effect
    if effect.groups != len(sight.network.images) or form.units is None:
        return ""
    size = np.linalg.norm(form.scores.effects(form.size).reshape(effect.groups, -1), axis=1)
    share = size**2 / max(float((size**2).sum()), 1e-300)
    order = np.argsort(-share, kind="stable")
    count = int(np.searchsorted(np.cumsum(share[order]), 0.5)) + 1
    if count > max(3, effect.groups // 4):
        return ""
    return "most in " + listed_places([sight.network.images[i] for i in order[:count]], "image")


def _of_names(misnamed: Misnamed, result: Result) -> Cause:
    """The cause of image points that were left out because they lie elsewhere."""
    off = misnamed.off_px[np.isfinite(misnamed.off_px)]
    amount = float(np.sqrt(np.mean(off**2))) if len(off) else 0.0
    where = listed_places(list(misnamed.labels), "point")
    share = len(misnamed.labels) / (len(result.network.xy) + len(misnamed.labels))
    return Cause(misnamed.code, f"{len(misnamed.labels)}", amount, share, 1.0, where,
                 advice(misnamed.code, f"{len(misnamed.labels)}"))  # fmt: skip
