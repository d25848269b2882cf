"""Markers of a frame: separate ones, read with OpenCV, and those that touch other squares."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr

from ...core.data import Array, Frame
from ...designs.boards import marker_cells, marker_dictionary
from ...io.board import BoardDesign
from .candidates import Saddles
from .tags import SEARCHES, read_tags, tag_outlines

__all__ = ["find_markers", "find_tags"]

_WRONG, _CHANCE = 0.06, 0.01
"""Share of the cells of a tag that may be misread; probability, not to be exceeded, that cells without any
order are read as a tag of the board."""
_WINDOW_PX = 13
"""Side of the squares in which the threshold of separate markers is found first."""
_FEW, _SHARE = 6, 0.25
"""Number of markers, and share of those of the board, from which no more are looked for."""


def find_markers(frame: Frame, design: BoardDesign, *, whole: bool = False) -> tuple[Array, NDArray[np.intp]]:
    """Corners (m, 4, 2) of markers in the frame, clockwise from the upper left, and their numbers (m,).

    `whole` takes markers without a wrong bit only, where no place on a board tests them.
    """
    assert design.dictionary is not None
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = design.border_bits
    parameters.minMarkerPerimeterRate = 0.01
    if whole:
        parameters.errorCorrectionRate = 0.0
        parameters.maxErroneousBitsInBorderRate = 0.0
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    pixels = frame.pixels
    if pixels.dtype != np.uint8:
        scale = 255.0 / max(float(pixels.max()), 1e-12)
        pixels = np.clip(pixels.astype(np.float64) * scale, 0, 255).astype(np.uint8)
    # OpenCV compares each candidate with every word, which takes most of its time; a part of the markers of a
    # ChArUco board is enough to find the corners between its squares.
    pixels = np.ascontiguousarray(pixels)
    if design.kind == "charuco" and not whole:
        read = _read_quickly(pixels, design, parameters)
        if len(read[1]) >= max(_FEW, _SHARE * len(design.markers[0])):
            return read
    detector = cv2.aruco.ArucoDetector(marker_dictionary(design.dictionary), parameters)
    corners, numbers, _ = detector.detectMarkers(pixels)
    if numbers is None or not len(numbers):
        return np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp)
    found = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
    return found, np.asarray(numbers).reshape(-1).astype(np.intp)


def _read_quickly(
    pixels: NDArray[np.uint8], design: BoardDesign, parameters: cv2.aruco.DetectorParameters
) -> tuple[Array, NDArray[np.intp]]:
    """Markers as :func:`find_markers` finds them, of those that one of OpenCV's windows separates from paper.

    OpenCV finds the candidates; they are read here, with as many wrong bits as OpenCV allows.
    """
    assert design.dictionary is not None
    dictionary = marker_dictionary(design.dictionary)
    most_wrong = int(dictionary.maxCorrectionBits * parameters.errorCorrectionRate)
    nothing = cv2.aruco.Dictionary(dictionary.bytesList[:1], dictionary.markerSize, 0)
    windows = parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = _WINDOW_PX
    read, _, others = cv2.aruco.ArucoDetector(nothing, parameters).detectMarkers(pixels)
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = windows
    corners = np.asarray([*read, *others], dtype=np.float64).reshape(-1, 4, 2)
    words = marker_cells(design)[1]
    index, corners = read_tags(pixels.astype(np.float32), corners, words, design.border_bits, most_wrong)
    return corners[index >= 0], design.markers[0][index[index >= 0]]


def find_tags(
    grey: NDArray[np.float32], saddles: Saddles, design: BoardDesign
) -> tuple[Array, NDArray[np.intp]]:
    """Corners (m, 4, 2) of the tags of an AprilGrid, clockwise from the upper left, and their numbers."""
    words = marker_cells(design)[1]
    bits = (words.shape[1] - 2 * design.border_bits) ** 2
    likely = 4 * len(words) * bdtr(np.arange(bits), bits, 0.5) < _CHANCE
    most = min(int(_WRONG * words[0].size), max(int(likely.sum()) - 1, 0))
    rings = np.zeros((0, 4), dtype=np.intp)
    for search in SEARCHES:
        rings = np.unique(np.concatenate([rings, tag_outlines(grey, saddles, *search)]), axis=0)
        index, corners = read_tags(grey, saddles.xy[rings], words, design.border_bits, most)
        read = index >= 0
        if read.sum() >= max(_FEW, _SHARE * len(words)):
            break
    return corners[read], design.markers[0][index[read]]
