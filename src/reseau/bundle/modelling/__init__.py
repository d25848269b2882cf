"""Adjustment of a network, search for a model, calibrations of the cameras."""
