"""Whether the analytic derivatives of a problem agree with differences."""

from __future__ import annotations

import numpy as np

from ..core.data import Array
from ..core.errors import UsageError
from .differences import JacobianCheck, compare_jacobians
from .models import HelmertModel, MarkovModel, model_of
from .problem import Problem

__all__ = ["check_jacobian"]


def check_jacobian(problem: Problem, at: Array | None = None) -> JacobianCheck:
    """Compare analytic derivatives with differences of fourth order.

    Parameters
    ----------
    problem : GaussMarkov or GaussHelmert
        With `jacobian` or `jacobians`; for the latter the derivatives by the observations are compared too,
        and are named ``observation 0``, ``observation 1`` … by their column.
    at : ndarray (u,), optional
        Where; at the approximate values by default.

    Returns
    -------
    JacobianCheck
        The greatest disagreement of all free parameters.

    Raises
    ------
    UsageError
        When the problem has no analytic derivatives.
    """
    x = np.array(problem.parameters.values if at is None else at, dtype=np.float64)
    model = model_of(problem)
    mask = problem.parameters.mask
    names = problem.parameters.free
    if isinstance(model, MarkovModel):
        if model.markov.jacobian is None:
            raise UsageError("has no analytic derivatives to check", where="problem")
        return compare_jacobians(model.jacobian(x)[:, mask], model.numeric(x)[:, mask], names)
    assert isinstance(model, HelmertModel)
    if model.helmert.jacobians is None:
        raise UsageError("has no analytic derivatives to check", where="problem")
    observed = problem.observations.ravel()
    model.evaluate(model.carry(x))
    (a, b), (a_numeric, b_numeric) = model.derivatives(observed, x), model.numeric(observed, x)
    u, k = len(x), b.shape[-1]
    of_x = compare_jacobians(a.reshape(-1, u)[:, mask], a_numeric.reshape(-1, u)[:, mask], names)
    columns = tuple(f"observation {i}" for i in range(k))
    of_l = compare_jacobians(b.reshape(-1, k), b_numeric.reshape(-1, k), columns)
    return of_x if of_x.error >= of_l.error else of_l
