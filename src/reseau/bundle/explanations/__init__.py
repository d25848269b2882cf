"""What is wrong in an adjusted network: explanations that compete for the same residuals."""

from .explain import Cause, Explanation, explain

__all__ = ["Cause", "Explanation", "explain"]
