"""The calibration: one document and one reader, which gives a mapping with covariance; apply, compare."""

from .assessment import Assessment, Cause, ErrorMap, NextPhotograph, Use, required_use
from .camera import CameraMapping, ProjectionField, projection_field
from .compare import FieldDifference, calibration_difference
from .conversion import in_model_of
from .document import Calibration, Covariance, Quantity
from .fiducials import FiducialMapping, calibration_of_fiducials, film_axes, scan_coordinates, scan_pixels
from .film import FilmFrameMapping, calibration_of_frame
from .group_a import CameraCorrection, Datum
from .group_b import InstrumentCorrection, ObjectPlane
from .local_model import LocalModel
from .mapping import CalibratedMapping
from .raster import CorrectedImage, undistorted_camera, write_corrected
from .reader import parse_calibration, read_calibration
from .sensor import Fields, SensorCorrection
from .tables import remap_tables, undistort_video, write_tables

__all__ = [
    "Assessment",
    "CalibratedMapping",
    "Calibration",
    "CameraCorrection",
    "CameraMapping",
    "Cause",
    "CorrectedImage",
    "Covariance",
    "Datum",
    "ErrorMap",
    "FiducialMapping",
    "FieldDifference",
    "Fields",
    "FilmFrameMapping",
    "InstrumentCorrection",
    "LocalModel",
    "NextPhotograph",
    "ObjectPlane",
    "ProjectionField",
    "Quantity",
    "SensorCorrection",
    "Use",
    "calibration_difference",
    "calibration_of_fiducials",
    "calibration_of_frame",
    "film_axes",
    "in_model_of",
    "parse_calibration",
    "projection_field",
    "read_calibration",
    "remap_tables",
    "required_use",
    "scan_coordinates",
    "scan_pixels",
    "undistort_video",
    "undistorted_camera",
    "write_corrected",
    "write_tables",
]
