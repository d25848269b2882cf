"""Markers of a frame, read with OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Frame
from ...designs.boards import marker_dictionary
from ...io.board import BoardDesign

__all__ = ["find_markers"]


def find_markers(frame: Frame, design: BoardDesign) -> tuple[Array, NDArray[np.intp]]:
    """Corners (m, 4, 2) of markers in the frame, clockwise from the upper left, and their numbers (m,)."""
    assert design.dictionary is not None
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = design.border_bits
    parameters.minMarkerPerimeterRate = 0.01
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    detector = cv2.aruco.ArucoDetector(marker_dictionary(design.dictionary), parameters)
    pixels = frame.pixels
    if pixels.dtype != np.uint8:
        scale = 255.0 / max(float(pixels.max()), 1e-12)
        pixels = np.clip(pixels.astype(np.float64) * scale, 0, 255).astype(np.uint8)
    corners, numbers, _ = detector.detectMarkers(np.ascontiguousarray(pixels))
    if numbers is None or not len(numbers):
        return np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp)
    found = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
    return found, np.asarray(numbers).reshape(-1).astype(np.intp)
