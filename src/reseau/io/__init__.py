"""Images and documents: designs, measurements, frame orientations, networks, lenses.

A document is a strict pydantic model: unknown and missing keys are errors that name the key. Files are
written completely or not at all.
"""

from .board import BoardDesign
from .design import DesignPoint, Mark, ReseauDesign, Rings
from .document import Document, Strict, read_text, write_whole
from .fiducials import (
    FiducialDesign,
    FiducialMark,
    FiducialOrientation,
    FiducialPoint,
    MarkPart,
    MeasuredFiducial,
)
from .frame import (
    CORNERS,
    EDGES,
    FormatCandidate,
    FrameCorners,
    FrameOrientation,
    FrameOutcome,
    FrameTransform,
    MeasuredCorner,
    MeasuredEdge,
    RivalEdge,
    RollSummary,
)
from .lens import LensDocument, LensSensor
from .measurement import MeasuredPoint, PhotographPoints, PointColumns, ReseauMeasurement
from .points import POINTS, points_document, points_of
from .reading import is_points, read_design, read_measurement
from .testfield import SHAPES, FieldLines, FieldTargets, TestfieldDesign, parse_design

__all__ = [
    "CORNERS",
    "EDGES",
    "POINTS",
    "SHAPES",
    "BoardDesign",
    "DesignPoint",
    "Document",
    "FiducialDesign",
    "FiducialMark",
    "FiducialOrientation",
    "FiducialPoint",
    "FieldLines",
    "FieldTargets",
    "FormatCandidate",
    "FrameCorners",
    "FrameOrientation",
    "FrameOutcome",
    "FrameTransform",
    "LensDocument",
    "LensSensor",
    "Mark",
    "MarkPart",
    "MeasuredCorner",
    "MeasuredEdge",
    "MeasuredFiducial",
    "MeasuredPoint",
    "PhotographPoints",
    "PointColumns",
    "ReseauDesign",
    "ReseauMeasurement",
    "Rings",
    "RivalEdge",
    "RollSummary",
    "Strict",
    "TestfieldDesign",
    "is_points",
    "parse_design",
    "points_document",
    "points_of",
    "read_design",
    "read_measurement",
    "read_text",
    "write_whole",
]
