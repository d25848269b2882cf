"""Diagnostics of an adjusted network: result, residual patterns, uncertainty over the image, remarks."""
