"""The version, as every document's provenance states it."""

__version__ = "0.2.0"
