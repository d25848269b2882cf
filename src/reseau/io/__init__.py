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
    LearntMark,
    MarkPart,
    MeasuredFiducial,
)
from .frame import (
    CORNERS,
    EDGES,
    CurveCandidate,
    FormatCandidate,
    FrameCorners,
    FrameOrientation,
    FrameTransform,
    MeasuredCorner,
    MeasuredEdge,
    RivalEdge,
)
from .lens import LensDocument, LensSensor
from .measurement import PhotographPoints, ReseauMeasurement
from .reading import read_design
from .testfield import SHAPES, FieldLines, FieldTargets, TestfieldDesign, parse_design

__all__ = [
    "CORNERS",
    "EDGES",
    "SHAPES",
    "BoardDesign",
    "CurveCandidate",
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
    "FrameTransform",
    "LearntMark",
    "LensDocument",
    "LensSensor",
    "Mark",
    "MarkPart",
    "MeasuredCorner",
    "MeasuredEdge",
    "MeasuredFiducial",
    "PhotographPoints",
    "ReseauDesign",
    "ReseauMeasurement",
    "Rings",
    "RivalEdge",
    "Strict",
    "TestfieldDesign",
    "parse_design",
    "read_design",
    "read_text",
    "write_whole",
]
