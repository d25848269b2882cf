"""What is wrong in an adjusted network: explanations that compete for the same residuals."""

from .explain import Explanation, explain
from .names import Misnamed, misnamed
from .sentences import described

__all__ = ["Explanation", "Misnamed", "described", "explain", "misnamed"]
