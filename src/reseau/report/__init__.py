"""Reports: pages that stand alone, figures, and drawings of targets."""

from .photo_i import photo_i_report

__all__ = ["photo_i_report"]
