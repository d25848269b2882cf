"""Markers of a frame: separate ones, read with OpenCV, and those that touch other squares."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Frame
from ...designs.boards import dictionary_cells, marker_cells, marker_dictionary
from ...io.board import BoardDesign
from .candidates import Saddles
from .tags import SEARCHES, read_tags, tag_outlines

DICTIONARIES = (
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
)
"""Those of OpenCV, of each series the largest, which contains the others."""

_WRONG, _CHANCE = 0.06, 0.01
"""Share of the cells of a tag that may be misread; probability, not to be exceeded, that cells without any
order are read as a tag of the board."""
_WINDOW_PX = 13
"""Side of the squares in which the threshold of separate markers is found first."""
_ANY = "DICT_4X4_50"
"""Dictionary with which OpenCV looks for outlines; the words are read afterwards."""
_FEW, _SHARE = 6, 0.25
"""Number of markers, and share of those of the board, from which no more are looked for."""


class ReadMarkers(NamedTuple):
    """Markers of one dictionary that were read in a frame."""

    dictionary: str
    border_bits: int
    touching: bool
    """Whether they touch other squares, as those of Kalibr's AprilGrid."""
    numbers: NDArray[np.intp]
    corners: Array
    """Corners (m, 4, 2), clockwise from the upper left."""


def find_markers(frame: Frame, design: BoardDesign, *, whole: bool = False) -> tuple[Array, NDArray[np.intp]]:
    """Corners (m, 4, 2) of markers in the frame, clockwise from the upper left, and their numbers (m,).

    `whole` takes markers without a wrong bit only, where no place on a board tests them.
    """
    assert design.dictionary is not None
    parameters = _parameters(design.border_bits)
    if whole:
        parameters.errorCorrectionRate = 0.0
        parameters.maxErroneousBitsInBorderRate = 0.0
    pixels = _eight_bits(frame)
    # OpenCV compares each candidate with every word, which takes most of its time; a part of the markers of a
    # ChArUco board is enough to find the corners between its squares.
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


def _parameters(border_bits: int) -> cv2.aruco.DetectorParameters:
    """Those of OpenCV, with which small markers are found, too."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.minMarkerPerimeterRate = 0.01
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return parameters


def _eight_bits(frame: Frame) -> NDArray[np.uint8]:
    """The pixels as OpenCV reads them."""
    pixels = frame.pixels
    if pixels.dtype != np.uint8:
        scale = 255.0 / max(float(pixels.max()), 1e-12)
        pixels = np.clip(pixels.astype(np.float64) * scale, 0, 255).astype(np.uint8)
    return np.ascontiguousarray(pixels)


def markers_of_any_dictionary(frame: Frame, grey: NDArray[np.float32], saddles: Saddles) -> list[ReadMarkers]:
    """Markers of a frame that are read without a wrong bit, of all dictionaries; those with most come first.

    Separate markers are looked for, and those that touch other squares, with borders of one bit or two.
    """
    found = []
    pixels = _eight_bits(frame)
    separate = _quadrangles(pixels, _parameters(1))
    if len(separate):
        ends = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 20, 0.01
        fine = cv2.cornerSubPix(pixels, separate.reshape(-1, 1, 2).astype(np.float32), (2, 2), (-1, -1), ends)
        separate = fine.reshape(-1, 4, 2).astype(np.float64)
    rings = np.unique(np.concatenate([tag_outlines(grey, saddles, *search) for search in SEARCHES]), axis=0)
    for corners, touching in ((separate, False), (saddles.xy[rings], True)):
        for name in DICTIONARIES:
            for border_bits in (1, 2):
                words = dictionary_cells(name, border_bits, turned=touching)
                index, quads = read_tags(grey, corners, words, border_bits, 0)
                read = np.flatnonzero(index >= 0)
                # Outlines of one marker are found several times.
                once = read[np.unique(index[read], return_index=True)[1]]
                if len(once):
                    found.append(ReadMarkers(name, border_bits, touching, index[once], quads[once]))
    return sorted(found, key=lambda each: -len(each.numbers))


def _read_quickly(
    pixels: NDArray[np.uint8], design: BoardDesign, parameters: cv2.aruco.DetectorParameters
) -> tuple[Array, NDArray[np.intp]]:
    """Markers as :func:`find_markers` finds them, of those that one of OpenCV's windows separates from paper.

    OpenCV finds the candidates; they are read here, with as many wrong bits as OpenCV allows.
    """
    assert design.dictionary is not None
    dictionary = marker_dictionary(design.dictionary)
    most_wrong = int(dictionary.maxCorrectionBits * parameters.errorCorrectionRate)
    corners = _quadrangles(pixels, parameters)
    words = marker_cells(design)[1]
    index, corners = read_tags(pixels.astype(np.float32), corners, words, design.border_bits, most_wrong)
    return corners[index >= 0], design.markers[0][index[index >= 0]]


def _quadrangles(pixels: NDArray[np.uint8], parameters: cv2.aruco.DetectorParameters) -> Array:
    """Corners (m, 4, 2) of what may be markers, in one of OpenCV's windows."""
    dictionary = marker_dictionary(_ANY)
    nothing = cv2.aruco.Dictionary(dictionary.bytesList[:1], dictionary.markerSize, 0)
    windows = parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = _WINDOW_PX
    read, _, others = cv2.aruco.ArucoDetector(nothing, parameters).detectMarkers(pixels)
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = windows
    return np.asarray([*read, *others], dtype=np.float64).reshape(-1, 4, 2)


def find_tags(
    grey: NDArray[np.float32], saddles: Saddles, design: BoardDesign
) -> tuple[Array, NDArray[np.intp]]:
    """Corners (m, 4, 2) of the tags of an AprilGrid, clockwise from the upper left, and their numbers."""
    words = marker_cells(design)[1]
    bits = (words.shape[1] - 2 * design.border_bits) ** 2
    likely = 4 * len(words) * scipy.special.bdtr(np.arange(bits), bits, 0.5) < _CHANCE
    most = min(int(_WRONG * words[0].size), max(int(likely.sum()) - 1, 0))
    rings = np.zeros((0, 4), dtype=np.intp)
    for search in SEARCHES:
        rings = np.unique(np.concatenate([rings, tag_outlines(grey, saddles, *search)]), axis=0)
        index, corners = read_tags(grey, saddles.xy[rings], words, design.border_bits, most)
        read = index >= 0
        if read.sum() >= max(_FEW, _SHARE * len(words)):
            break
    return corners[read], design.markers[0][index[read]]
