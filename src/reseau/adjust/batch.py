"""Many small Gauss–Markov problems of one shape, adjusted side by side.

The mathematics is that of :func:`reseau.adjust.adjust`; here it is written over a leading axis, so that
hundreds of image patches are matched in the time of a few. The problems share nothing: each has its own
damping and leaves the work as soon as it has converged, and one that cannot be solved is marked without
touching the others.
"""

from __future__ import annotations

from numpy.typing import ArrayLike

from ..core.threads import one_thread
from .chord import Chord, ValuesFunction
from .marquardt import BatchAdjustment, BatchFunction, BatchOptions, BatchReason, Marquardt

__all__ = ["BatchAdjustment", "BatchOptions", "BatchReason", "adjust_batch"]


def adjust_batch(
    function: BatchFunction,
    initial: ArrayLike,
    observations: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    prior: tuple[ArrayLike, ArrayLike] | None = None,
    values: ValuesFunction | None = None,
    options: BatchOptions | None = None,
) -> BatchAdjustment:
    """Adjust k independent problems of n observations and u parameters by Levenberg–Marquardt.

    Parameters
    ----------
    function : callable
        `function(x, rows)` with x (m, u), the parameters, and rows (m,), the indices of the problems they
        belong to, gives the computed observations (m, n) and their Jacobian (m, n, u). Only problems still
        active are asked for. Values that are not finite refuse a step; they do no harm at weight zero.
    initial : array_like (k, u)
        Approximate values.
    observations : array_like (k, n)
        What was observed; may be NaN where the weight is zero.
    weights : array_like (k, n), optional
        1/σ² of the observations up to a common factor; zero for those that are missing. Ones by default.
    prior : (mean, sigma), optional
        Observed parameters: mean (k, u) with the standard deviations (u,) of unit weight; infinite where a
        parameter is not observed.
    values : callable, optional
        `values(x, rows)` gives the computed observations (m, n) alone. Worth while where that is much cheaper
        than with the Jacobian: then each problem keeps its Jacobian as long as it serves; see
        :class:`reseau.adjust.chord.Chord`.
    options : BatchOptions, optional
        How to iterate.

    Returns
    -------
    BatchAdjustment
        Of all problems; look at `converged`.

    Raises
    ------
    UsageError
        When the shapes do not belong together, or weights or sigmas are negative or NaN.

    Notes
    -----
    Damping after Nielsen (1999), *Damping parameter in Marquardt's method*, IMM-REP-1999-05; columns
    are scaled to normal equations of unit diagonal (Marquardt 1963).

    Examples
    --------
    Two straight lines, the second with a missing observation:

    >>> import numpy as np
    >>> t = np.arange(4.0)
    >>> def line(x, rows):
    ...     return x[:, :1] + x[:, 1:] * t, np.broadcast_to(np.column_stack([t**0, t]), (len(rows), 4, 2))
    >>> y, weights = [[1, 3, 5, 7], [2, 1, 9, -1]], [[1, 1, 1, 1], [1, 1, 0, 1]]
    >>> fit = adjust_batch(line, np.zeros((2, 2)), y, weights=weights)
    >>> fit.estimates.round(6) + 0.0
    array([[ 1.,  2.],
           [ 2., -1.]])
    >>> fit.redundancy
    array([2, 1])
    """
    given = function, initial, observations, weights, prior, options or BatchOptions()
    work = Marquardt(*given) if values is None else Chord(values, *given)
    with one_thread():
        work.start()
        for _ in range(work.options.max_iterations):
            if not work.iterate():
                break
        return work.finish()
