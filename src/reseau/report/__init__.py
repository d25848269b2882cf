"""Reports: pages that stand alone, figures, and drawings of targets."""

from .page import applied_report, oscilloscope_report

__all__ = ["applied_report", "oscilloscope_report"]
