"""The version, as every document's provenance states it."""

__version__ = "1.0.0"
