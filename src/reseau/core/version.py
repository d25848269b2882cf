"""The version, as every document's provenance states it."""

__all__ = ["__version__"]

__version__ = "0.2.0"
