"""Independent parts of a computation, done in this process, in several, or on a cluster.

An :class:`Executor` yields the outcome of each job in the order of the jobs; the outcomes are the same
whichever does the work. :class:`Outputs` keeps them by what they were computed from, so that a computation
that is started again takes up where it ended.
"""

from ..core.executors import Executor, Here, Processes
from .cluster import Outputs, executor_at

__all__ = ["Executor", "Here", "Outputs", "Processes", "executor_at"]
