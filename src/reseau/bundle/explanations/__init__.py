"""What is wrong in an adjusted network: explanations that compete for the same residuals."""

from .explain import explain

__all__ = ["explain"]
