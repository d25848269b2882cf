"""Control charts of calibrations: has a parameter drifted between the runs of a bench?

Each series is a parameter of the calibration (or the norm of its field) over the runs. A value is predicted
from the earlier runs alone: the regression on a constant and covariates is solved with the rows x_t − φ
x_{t−1}, where φ is the autocorrelation, and the residual of the new row over its standard deviation is a t
value, which is turned into a standard normal score (self-starting charts: Hawkins 1987, Quesenberry 1991;
recursive residuals: Brown, Durbin and Evans 1975). Scores of different runs are independent however few runs
there are, so that limits for known parameters hold their rate of false alarms after 20 runs as after 1000.

φ is not known. The charts use an upper limit of it: with a φ that is too large the scores alternate in sign,
and a sum of them signals too rarely instead of too often. This costs power; :attr:`Monitored.width` tells
how much. Nor is it known that the series are normal: a score counts no more than it would in a t distribution
of a few degrees of freedom, so that a single bad run is no drift.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

import numpy as np
import scipy

from ..core.data import Array, Mask, Rows
from ..core.errors import UsageError
from .runlength import Cusum, Ewma, Shewhart

Kind = Literal["cusum", "ewma", "shewhart"]

_SPENT = 0.92
"""Part of the rate that the limits use; the rest is for series whose φ exceeds its upper limit."""


@dataclass(frozen=True)
class ChartOptions:
    """How series are monitored.

    Parameters
    ----------
    kind : {"cusum", "ewma", "shewhart"}
        The chart. Every kind also has a Shewhart limit for single values.
    rate : float
        False alarms per year over all charts of a bench together.
    runs_per_year : float
        Number of runs in a year.
    shift : float
        Shift that a CUSUM chart finds fastest, in standard deviations between runs.
    weight : float
        λ of an EWMA chart.
    autocorrelation : float
        Autocorrelation φ of consecutive runs that is always considered; 0: runs are independent.
    correlated : float
        Largest φ that is considered where the series show more than that, by their median.
    tails : float
        Degrees of freedom (above 2) of the t distribution with the heaviest tails that are considered;
        infinite: series are normal, as those are whose parameters are known.
    confidence : float
        That of the upper limit of φ.
    least : int
        Number of earlier runs without which nothing is judged.
    learned : float
        Width up to which a chart has learned; see :attr:`Monitored.width`.

    Examples
    --------
    >>> ChartOptions(rate=0.2).kind
    'cusum'
    """

    kind: Kind = "cusum"
    rate: float = 0.1
    runs_per_year: float = 52.0
    shift: float = 1.0
    weight: float = 0.12
    autocorrelation: float = 0.3
    correlated: float = 0.7
    tails: float = 8.0
    confidence: float = 0.95
    least: int = 8
    learned: float = 1.2

    def __post_init__(self) -> None:
        for name in ("rate", "runs_per_year", "shift", "weight"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{getattr(self, name):g} is not above 0", where=name)
        if not self.rate < self.runs_per_year / 2:
            raise UsageError(f"{self.rate:g} a year is a false alarm in every other run", where="rate")
        if not 0 <= self.autocorrelation < 1:
            raise UsageError(f"{self.autocorrelation:g} is not from 0 to below 1", where="autocorrelation")
        if self.autocorrelation and not self.autocorrelation <= self.correlated < 1:
            raise UsageError(
                f"{self.correlated:g} is not from `autocorrelation` to below 1", where="correlated"
            )
        if not self.tails > 2:
            raise UsageError(f"{self.tails:g} is not above 2", where="tails")
        if not 0.5 <= self.confidence < 1:
            raise UsageError(f"{self.confidence:g} is not from 0.5 to below 1", where="confidence")
        if self.least < 4:
            raise UsageError(f"{self.least} is too small", where="least", do="use at least 4")
        if self.kind not in ("cusum", "ewma", "shewhart"):
            raise UsageError(f"{self.kind!r} is no chart", where="kind", do="use cusum, ewma or shewhart")


@dataclass(frozen=True)
class Limits:
    """Limits of the charts of a bench, for scores.

    Parameters
    ----------
    kind : {"cusum", "ewma", "shewhart"}
        The chart.
    parameter : float
        k of a CUSUM chart, λ of an EWMA chart.
    limit : float
        Limit of the sums, or of the averages in their standard deviations; infinite for a Shewhart chart.
    single : float
        Limit of a single score.

    Examples
    --------
    >>> limits = design(20)
    >>> round(limits.limit, 2), round(limits.single, 2)
    (7.58, 4.29)
    >>> round(limits.arl(1.0), 1), round(limits.arl(3.0), 2)
    (15.5, 3.32)
    """

    kind: Kind
    parameter: float
    limit: float
    single: float

    def arl(self, shift: float = 0.0) -> float:
        """Average run length of one two-sided chart, from the start, with known parameters.

        Parameters
        ----------
        shift : float
            Shift of the series, in standard deviations.
        """
        return _arl(self, shift)


@dataclass(frozen=True, eq=False)
class KnownSeries:
    """Mean, standard deviation and autocorrelation of series that need not be estimated.

    Parameters
    ----------
    mean, sigma : ndarray (c,)
        Of each series.
    autocorrelation : ndarray (c,)
        Of consecutive runs.

    Examples
    --------
    >>> KnownSeries(np.zeros(2), np.ones(2)).autocorrelation
    array([0., 0.])
    """

    mean: Array
    sigma: Array
    autocorrelation: Array = field(default_factory=lambda: np.zeros(1))

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "autocorrelation", np.broadcast_to(self.autocorrelation, np.shape(self.mean))
        )


@dataclass(frozen=True, eq=False)
class Monitored:
    """Charts of c series over n runs, for any number of benches (the leading axes).

    Parameters
    ----------
    limits : Limits
        Limits of the charts.
    score : ndarray (..., n, c)
        Standard normal scores; NaN where nothing is judged.
    upper, lower : ndarray (..., n, c)
        Statistics of the charts, positive: sums or averages upwards and downwards, before they restart.
    alarm : ndarray (..., n, c) of int
        1 and −1 where a chart signals an increase or a decrease; it then restarts.
    expected, sigma : ndarray (..., n, c)
        Prediction of each value, and the standard deviation of value minus prediction.
    width : ndarray (..., n, c)
        How much larger than with known parameters a shift must be to have the same effect on the scores.
    learning : ndarray (..., n, c) of bool
        Whether the chart is wider than `ChartOptions.learned`, or does not judge yet.
    autocorrelation : ndarray (..., n, c)
        Autocorrelation φ that the chart uses; above `ChartOptions.autocorrelation` where the series are
        correlated.

    Examples
    --------
    >>> values = np.random.default_rng(1).normal(size=(60, 2))
    >>> values[40:, 1] += 2.0
    >>> found = monitor(values, ChartOptions(autocorrelation=0.0))
    >>> np.argwhere(found.alarm)[0].tolist(), found.first_alarm()
    ([44, 1], (44, 1))
    """

    limits: Limits
    score: Array
    upper: Array
    lower: Array
    alarm: Rows
    expected: Array
    sigma: Array
    width: Array
    learning: Mask
    autocorrelation: Array

    @property
    def alarms(self) -> Mask:
        """Runs (..., n) in which at least one chart signals."""
        found: Mask = (self.alarm != 0).any(axis=-1)
        return found

    def first_alarm(self) -> tuple[int, int] | None:
        """Run and series of the first signal of one bench, or None."""
        where = np.argwhere(self.alarm.reshape(-1, self.alarm.shape[-1]))
        return None if not len(where) else (int(where[0, 0]), int(where[0, 1]))

    def since(self, run: int, series: int) -> int:
        """Run after which a chart that signals in `run` last had no sum: the estimated time of the change.

        Parameters
        ----------
        run, series : int
            Index of a signal of one bench.
        """
        sums = (self.upper if self.alarm[run, series] >= 0 else self.lower)[: run + 1, series]
        earlier = np.flatnonzero((np.nan_to_num(sums) <= 0) | (self.alarm[: run + 1, series] != 0))
        earlier = earlier[earlier < run]
        return int(earlier[-1]) + 1 if len(earlier) else 0


def design(sides: int, options: ChartOptions | None = None) -> Limits:
    """Limits of the charts of a bench that hold the joint rate of false alarms.

    Parameters
    ----------
    sides : int
        Number of charts, a two-sided one counted twice.
    options : ChartOptions, optional
        Rate, runs in a year and chart.

    Returns
    -------
    Limits
        Each side has the same part of the rate; one tenth of it belongs to single scores. Correlated series
        signal together, so that the rate is at most the one asked for.

    Raises
    ------
    UsageError
        If there is no chart.

    Examples
    --------
    >>> limits = design(2)
    >>> round(limits.arl()), 52 / 0.1
    (565, 520.0)
    """
    options = options or ChartOptions()
    if sides < 1:
        raise UsageError(f"{sides} charts cannot be designed", where="sides")
    rate = _SPENT * options.rate / options.runs_per_year / sides
    return _design(options.kind, rate, options.shift / 2, options.weight)


@lru_cache(maxsize=64)
def _design(kind: Kind, rate: float, reference: float, weight: float) -> Limits:
    """Limits by the rate of each side per run."""
    if kind == "shewhart":
        return Limits(kind, 1.0, np.inf, float(-scipy.special.ndtri(rate)))
    single = float(-scipy.special.ndtri(0.1 * rate))
    parameter = reference if kind == "cusum" else weight

    def excess(limit: float) -> float:
        return float(np.log(_arl(Limits(kind, parameter, limit, single), 0.0) * 2.0 * rate))

    high = 60.0 / reference if kind == "cusum" else single
    found = scipy.optimize.brentq(excess, 0.2, high, xtol=1e-6)
    return Limits(kind, parameter, float(found), single)


def _arl(limits: Limits, shift: float) -> float:
    """Average run length of a two-sided chart with its limit of single scores."""
    if limits.kind == "shewhart":
        return Shewhart(limits.single).arl(shift)
    if limits.kind == "cusum":
        return Cusum(limits.parameter, limits.limit, limits.single).arl(shift)
    # The rates of both limits add up, at most.
    return 1.0 / (
        1.0 / Ewma(limits.parameter, limits.limit).arl(shift) + 1.0 / Shewhart(limits.single).arl(shift)
    )


def monitor(
    values: Array,
    options: ChartOptions | None = None,
    *,
    one_sided: tuple[int, ...] = (),
    covariates: Array | None = None,
    known: KnownSeries | None = None,
) -> Monitored:
    """Monitor series of calibrations.

    Parameters
    ----------
    values : ndarray (..., n, c)
        Values of c series over n runs, in time order; NaN where a run has none. Leading axes are benches.
    options : ChartOptions, optional
        Charts and their rate of false alarms.
    one_sided : tuple of int
        Series of which only increases are signalled, such as a norm.
    covariates : ndarray (..., n, q), optional
        Temperature, zoom and the like of each run: the series are predicted by them, linearly.
    known : KnownSeries, optional
        Mean, sigma and autocorrelation, if they need not be estimated; not with covariates.

    Raises
    ------
    UsageError
        If shapes do not agree.

    Notes
    -----
    Derived in ``docs/mathematics/recalibration.md``.

    A missing run counts as none: the next run is predicted from the last one with the same φ, although their
    correlation is smaller, which makes signals rarer.

    Examples
    --------
    >>> values = np.random.default_rng(2).normal(size=(1000, 60, 10))
    >>> found = monitor(values)
    >>> found.alarms.shape, bool(found.alarms[:, :8].any())
    ((1000, 60), False)
    """
    options = options or ChartOptions()
    x = np.asarray(values, dtype=np.float64)
    if x.ndim < 2 or 0 in x.shape[-2:]:
        raise UsageError(f"have the shape {x.shape}, not (..., runs, series)", where="values")
    (n, c), lead = x.shape[-2:], x.shape[:-2]
    z = _design_rows(covariates, lead, n)
    if known is not None and (covariates is not None or np.shape(known.mean) != (c,)):
        raise UsageError(f"must be that of {c} series, without covariates", where="known")
    limits = design(2 * c - len(one_sided), options)
    predictor = _Predictor(x, z, options, limits.single) if known is None else _KnownPredictor(known)
    shape = (*lead, n, c)
    score, upper, lower, expected, sigma, width, phi = (np.full(shape, np.nan) for _ in range(7))
    alarm = np.zeros(shape, dtype=np.intp)
    up, down = np.zeros((*lead, c)), np.zeros((*lead, c))
    for k in range(n):
        now = x[..., k, :]
        at = (..., k, slice(None))
        score[at], expected[at], sigma[at], width[at], phi[at] = predictor.predict(now, z[..., k, :])
        up, down = _updated(limits, up, down, score[at])
        upper[at], lower[at] = up, down
        signal = _signals(limits, up, down, score[at])
        signal[..., list(one_sided)] = np.maximum(signal[..., list(one_sided)], 0)
        alarm[at] = signal
        up, down = np.where(signal != 0, 0.0, up), np.where(signal != 0, 0.0, down)
        predictor.learn(now, z[..., k, :])
    learning = ~(width <= options.learned)
    return Monitored(limits, score, upper, lower, alarm, expected, sigma, width, learning, phi)


def _design_rows(covariates: Array | None, lead: tuple[int, ...], n: int) -> Array:
    """Rows of the regression (..., n, p): a constant and the covariates, from the first run on."""
    ones = np.ones((*lead, n, 1))
    if covariates is None:
        return ones
    given = np.asarray(covariates, dtype=np.float64)
    if given.shape[:-1] != (*lead, n):
        raise UsageError(f"have the shape {given.shape}, not ({n} runs, covariates)", where="covariates")
    if not np.isfinite(given).all():
        raise UsageError("are not known for each run", where="covariates", do="leave out those runs")
    scale = np.abs(given - given[..., :1, :]).max(axis=-2, keepdims=True, initial=0.0)
    scaled = (given - given[..., :1, :]) / np.where(scale > 0, scale, 1.0)
    return np.concatenate([ones, scaled], axis=-1)


def _updated(limits: Limits, up: Array, down: Array, score: Array) -> tuple[Array, Array]:
    """Statistics after a run; unchanged where it has no score."""
    w = np.nan_to_num(score)
    if limits.kind == "cusum":
        there = np.isfinite(score)
        more = np.maximum(up + w - limits.parameter, 0.0), np.maximum(down - w - limits.parameter, 0.0)
        return np.where(there, more[0], up), np.where(there, more[1], down)
    if limits.kind == "shewhart":
        return w, -w
    spread = np.sqrt(limits.parameter / (2.0 - limits.parameter))
    average = np.where(np.isfinite(score), up + limits.parameter * (w / spread - up), up)
    return average, -average


def _signals(limits: Limits, up: Array, down: Array, score: Array) -> Rows:
    """1, −1 or 0 for each chart."""
    w = np.nan_to_num(score)
    rise, fall = (up > limits.limit) | (w > limits.single), (down > limits.limit) | (w < -limits.single)
    return np.where(rise, 1, np.where(fall, -1, 0)).astype(np.intp)


class _KnownPredictor:
    """Scores of series with known mean, sigma and autocorrelation."""

    def __init__(self, known: KnownSeries) -> None:
        self._known, self._last = known, np.array(np.nan)

    def predict(self, now: Array, _: Array) -> tuple[Array, Array, Array, Array, Array]:
        mean, sigma, phi = self._known.mean, self._known.sigma, self._known.autocorrelation
        follows = np.isfinite(self._last)
        expected = np.where(follows, mean + phi * (np.nan_to_num(self._last) - mean), mean)
        spread = np.broadcast_to(np.where(follows, sigma * np.sqrt(1.0 - phi * phi), sigma), now.shape)
        return (now - expected) / spread, expected, spread, np.ones(now.shape), phi

    def learn(self, now: Array, _: Array) -> None:
        self._last = np.where(np.isfinite(now), now, self._last)


class _Predictor:
    """Scores of series predicted from their earlier runs.

    It holds the sums of products of each run with itself and with the run before it, from which the normal
    equations of the rows z_t − φ z_{t−1} follow for any φ.
    """

    def __init__(self, x: Array, z: Array, options: ChartOptions, single: float) -> None:
        (n, c), lead, p = x.shape[-2:], x.shape[:-2], z.shape[-1]
        self._options, self._normal = options, float(scipy.special.ndtri(options.confidence))
        # Differences from the first value keep the sums of products accurate.
        first = np.argmax(np.isfinite(x), axis=-2, keepdims=True)
        self._origin = np.nan_to_num(np.take_along_axis(x, first, axis=-2)[..., 0, :])
        self._pairs = np.zeros((*lead, c), dtype=np.intp)
        self._zz = [np.zeros((*lead, c, p, p)) for _ in range(3)]
        self._zx = [np.zeros((*lead, c, p)) for _ in range(3)]
        self._xx = [np.zeros((*lead, c)) for _ in range(3)]
        self._z, self._x = np.zeros((*lead, c, p)), np.full((*lead, c), np.nan)
        degrees = np.maximum(np.arange(n + 1), 1)
        self._wider = -scipy.special.stdtrit(degrees, scipy.special.ndtr(-single)) / single

    def predict(self, now: Array, row: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Scores, predicted values, their standard deviations, the widths of the charts, and φ."""
        p = row.shape[-1]
        judged = (self._pairs + 1 >= max(self._options.least, p + 3)) & np.isfinite(now)
        degrees = np.maximum(self._pairs - p, 1)
        estimate, phi = self._autocorrelation(judged)
        normal = _at(self._zz, phi[..., None, None]) + np.where(judged, 0.0, 1.0)[..., None, None] * np.eye(p)
        right, square = _at(self._zx, phi[..., None]), _at(self._xx, phi)
        a = row[..., None, :] - phi[..., None] * self._z
        solved = _solve(normal, np.stack([right, a], axis=-1))
        beta = solved[..., 0]
        variance = np.maximum(square - (right * beta).sum(axis=-1), 0.0) / degrees
        leverage = (a * solved[..., 1]).sum(axis=-1)
        spread = np.sqrt(variance * (1.0 + leverage))
        expected = (a * beta).sum(axis=-1) + phi * np.nan_to_num(self._x)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (now - self._origin - expected) / spread
        t[~judged | ~(spread > 0)] = np.nan
        size = -scipy.special.ndtri(scipy.special.stdtr(degrees, -np.abs(t)))
        # 37: the smallest probability of doubles.
        score = np.sign(t) * self._in_tails(np.minimum(size, 37.0))
        width = _visible(estimate, estimate) / _visible(phi, estimate)
        width = width * self._wider[degrees] * np.sqrt(1.0 + leverage)
        hidden = np.where(judged, 0.0, np.nan)
        return score, expected + self._origin + hidden, spread + hidden, width + hidden, phi + hidden

    def _in_tails(self, size: Array) -> Array:
        """Normal scores of values of `size` standard deviations of a t distribution, at most `size`."""
        nu = self._options.tails
        if np.isinf(nu):
            return size
        found: Array = -scipy.special.ndtri(scipy.special.stdtr(nu, -size * np.sqrt(nu / (nu - 2.0))))
        return np.minimum(size, found)

    def _autocorrelation(self, judged: Mask) -> tuple[Array, Array]:
        """φ estimated from the residuals, corrected for its bias, and its upper limit (..., c)."""
        usual, p = self._options.autocorrelation, self._z.shape[-1]
        if usual == 0:
            return np.zeros(judged.shape), np.zeros(judged.shape)
        pairs = np.maximum(self._pairs, 1)
        normal = self._zz[0] + np.where(judged, 0.0, 1.0)[..., None, None] * np.eye(p)
        beta = _solve(normal, self._zx[0][..., None])[..., 0]
        own, lagged, before = (
            xx - 2.0 * (beta * zx).sum(axis=-1) + np.einsum("...i,...ij,...j->...", beta, zz, beta)
            for xx, zx, zz in zip(self._xx, self._zx, self._zz, strict=True)
        )
        size = own + before
        raw = np.clip(np.where(size > 0, lagged / np.where(size > 0, size, 1.0), 0.0), -1.0, 1.0)
        corrected = raw + (p + (p + 2) * raw) / pairs  # Kendall (1954), for p = 1
        # A shift of one series resembles autocorrelation; the median of all series is not moved by it.
        together = _median(np.where(judged, corrected, np.nan))
        largest = np.clip(together, usual, max(usual, self._options.correlated))
        bound = corrected + self._normal * np.sqrt((1.0 - raw * raw) / pairs)
        bound = np.where(judged, np.clip(bound, 0.0, largest), usual)
        return np.clip(corrected, 0.0, bound), bound

    def learn(self, now: Array, row: Array) -> None:
        """Take a run into the sums."""
        there = np.isfinite(now)
        x, z = now - self._origin, np.broadcast_to(row[..., None, :], self._z.shape)
        pair = there & np.isfinite(self._x)
        x0, x1 = np.where(pair, x, 0.0), np.where(pair, self._x, 0.0)
        z0, z1 = np.where(pair[..., None], z, 0.0), np.where(pair[..., None], self._z, 0.0)
        self._pairs = self._pairs + pair
        for k, (one, other) in enumerate((((z0, x0), (z0, x0)), ((z0, x0), (z1, x1)), ((z1, x1), (z1, x1)))):
            (za, xa), (zb, xb) = one, other
            zz, zx = za[..., :, None] * zb[..., None, :], za * xb[..., None]
            if k == 1:
                zz, zx = zz + np.swapaxes(zz, -1, -2), zx + zb * xa[..., None]
            self._zz[k] += zz
            self._zx[k] += zx
            self._xx[k] += xa * xb * (2.0 if k == 1 else 1.0)
        self._z = np.where(there[..., None], z, self._z)
        self._x = np.where(there, x, self._x)


def _at(sums: list[Array], phi: Array) -> Array:
    """Sums of products of the rows z_t − φ z_{t−1}."""
    return sums[0] - phi * sums[1] + phi * phi * sums[2]


def _solve(matrix: Array, right: Array) -> Array:
    """Solve small systems; a division for one unknown."""
    if matrix.shape[-1] == 1:
        return right / np.where(matrix == 0, 1.0, matrix)
    return np.linalg.pinv(matrix, hermitian=True) @ right


def _median(values: Array) -> Array:
    """Median over the series (..., 1) of those that have a value; 0 where none has."""
    ordered = np.sort(values, axis=-1)  # NaN last
    count = np.isfinite(values).sum(axis=-1, keepdims=True)
    ends = [np.take_along_axis(ordered, np.maximum(k, 0), axis=-1) for k in ((count - 1) // 2, count // 2)]
    return np.where(count > 0, (ends[0] + ends[1]) / 2, 0.0)


def _visible(phi: Array, true: Array) -> Array:
    """Effect of a shift of one standard deviation on scores that use φ, when the true one is `true`."""
    return (1.0 - phi) / np.sqrt(1.0 - 2.0 * phi * true + phi * phi)
