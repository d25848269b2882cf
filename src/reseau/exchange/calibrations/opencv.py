"""OpenCV's camera matrix and distortion, as ``cv2.FileStorage`` reads and writes them (YAML, XML or JSON).

Keys are those of OpenCV's calibration sample: ``image_width``, ``image_height``, ``camera_matrix``,
``distortion_coefficients``; ``distortion_model`` is ``fisheye`` for the module of that name. Pixels are
counted from the centre of the first one, as here.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...bundle import Camera
from ...core.errors import FormatError, UsageError
from ...optics.cameras.opencv import opencv_coefficients
from .plain import CENTRE, FISHEYE, Mounted, given, opencv_camera


def write(camera: Camera) -> str:
    """Return the text of a YAML file."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    fx, fy, cx, cy = given(camera, *CENTRE)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_name", camera.id)
    storage.write("distortion_model", "fisheye" if camera.model == "fisheye" else "opencv")
    storage.write("camera_matrix", np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
    storage.write("distortion_coefficients", np.array(coefficients(camera)).reshape(-1, 1))
    return storage.releaseAndGetString()


def write_pair(rig: Sequence[Mounted]) -> str:
    """Return the text of a YAML file with the keys of OpenCV's sample of stereo calibration.

    A point of the left camera is x' = R x + T in the right one, mm.

    Raises
    ------
    UsageError
        When there are more than two cameras.
    """
    if len(rig) > 2:
        raise UsageError("holds two cameras", where="opencv", do="use kalibr or colmap, or write pairs")
    left, right = rig
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", left.camera.width)
    storage.write("image_height", left.camera.height)
    for number, mounted in enumerate((left, right), start=1):
        fx, fy, cx, cy = given(mounted.camera, *CENTRE)
        storage.write(f"M{number}", np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
        storage.write(f"D{number}", np.array(coefficients(mounted.camera)).reshape(1, -1))
    storage.write("R", np.ascontiguousarray(right.rotation))
    storage.write("T", right.translation.reshape(3, 1))
    return storage.releaseAndGetString()


def coefficients(camera: Camera) -> list[float]:
    """Return the shortest list of OpenCV's coefficients that holds the camera."""
    if camera.model == "fisheye":
        return given(camera, *FISHEYE)
    return opencv_coefficients(camera.parameters)


def recognises(text: str) -> bool:
    """Whether this is such a file."""
    head = text.lstrip("\ufeff \n")
    return head.startswith(("%YAML", "<?xml", "{")) and "camera_matrix" in text.lower()


def read(text: str, path: Path) -> Camera:
    """Read a camera.

    Raises
    ------
    FormatError
        When it is no such file, or the camera is incomplete.
    """
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        matrix = _first(storage, ("camera_matrix", "Camera_Matrix", "cameraMatrix")).mat()
        found = _first(storage, ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs")).mat()
        sides = (("image_width", "image_Width"), ("image_height", "image_Height"))
        size = [int(_first(storage, names).real()) for names in sides]
        model, name = (_first(storage, (key,)).string() for key in ("distortion_model", "camera_name"))
    except cv2.error:
        raise FormatError("is not a file of OpenCV's FileStorage", where=path) from None
    if matrix is None or matrix.shape != (3, 3):
        raise FormatError("has no camera_matrix of 3 × 3", where=path)
    if found is None:
        raise FormatError("has no distortion_coefficients", where=path)
    if min(size) < 1:
        raise FormatError("has no image_width and image_height", where=path)
    (fx, _, cx), (_, fy, cy), _ = np.asarray(matrix, dtype=np.float64).tolist()
    given = np.asarray(found, dtype=np.float64).ravel().tolist()
    fisheye = model == "fisheye"
    return opencv_camera(name or path.stem, size, (fx, fy), (cx, cy), given, path, fisheye=fisheye)


def _first(storage: Any, names: tuple[str, ...]) -> Any:
    nodes = [storage.getNode(name) for name in names]
    return next((node for node in nodes if not node.empty()), nodes[0])
