"""What is wrong in an adjusted network: explanations that compete for the same residuals."""

from .explain import Cause, Explanation, explain
from .names import Misnamed, misnamed
from .sentences import described

__all__ = ["Cause", "Explanation", "Misnamed", "described", "explain", "misnamed"]
