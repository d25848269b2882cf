"""Reports: pages that stand alone, figures, and drawings of targets."""

from .page import oscilloscope_report

__all__ = ["oscilloscope_report"]
