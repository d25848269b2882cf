"""Boards of other programs, and single tags."""
