"""The calibration: one document and one reader, which gives a mapping with covariance; apply, compare."""

from .assessment import Cause, required_use
from .camera import CameraMapping, projection_field
from .compare import FieldDifference, calibration_difference
from .document import Calibration
from .fiducials import FiducialMapping, calibration_of_fiducials, film_axes, scan_coordinates, scan_pixels
from .film import FilmFrameMapping, calibration_of_frame
from .group_a import CameraCorrection, Datum
from .group_b import InstrumentCorrection, ObjectPlane
from .local_model import LocalModel
from .raster import CorrectedImage
from .reader import read_calibration
from .tables import undistort_video, write_tables

__all__ = [
    "Calibration",
    "CameraCorrection",
    "CameraMapping",
    "Cause",
    "CorrectedImage",
    "Datum",
    "FiducialMapping",
    "FieldDifference",
    "FilmFrameMapping",
    "InstrumentCorrection",
    "LocalModel",
    "ObjectPlane",
    "calibration_difference",
    "calibration_of_fiducials",
    "calibration_of_frame",
    "film_axes",
    "projection_field",
    "read_calibration",
    "required_use",
    "scan_coordinates",
    "scan_pixels",
    "undistort_video",
    "write_tables",
]
