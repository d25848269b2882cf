"""Measurement of a coded testfield in one frame: find its lines, read its squares, measure its targets."""
