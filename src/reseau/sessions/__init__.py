"""Sessions: acquisitions that are measured live and can be computed again from the archive.

Examples
--------
Compute the results of a session again, in a program:

>>> from reseau import sessions
>>> from reseau.archive import Archive
>>> with Archive.open("archive") as archive:                            # doctest: +SKIP
...     all(each.same for each in sessions.rerun(archive.session("monday")))
True
"""

from .conducting import (
    CALIBRATION,
    begin,
    calibration_of,
    capture,
    check,
    lock,
    parameters_of,
    procedure_of,
    rerun,
    rerun_all,
    resume,
)
from .kinds import CORNERS, KINDS, OF_FILES, SCENE, Reported, SessionKind, kind_of, own_plan
from .parameters import (
    BlurredParameters,
    FilmParameters,
    FramesParameters,
    OscilloscopeParameters,
    OwnParameters,
    PhotographsParameters,
    ScanParameters,
    SensorParameters,
    SessionParameters,
    TestfieldParameters,
    present_keys,
)

__all__ = [
    "CALIBRATION",
    "CORNERS",
    "KINDS",
    "OF_FILES",
    "SCENE",
    "BlurredParameters",
    "FilmParameters",
    "FramesParameters",
    "OscilloscopeParameters",
    "OwnParameters",
    "PhotographsParameters",
    "Reported",
    "ScanParameters",
    "SensorParameters",
    "SessionKind",
    "SessionParameters",
    "TestfieldParameters",
    "begin",
    "calibration_of",
    "capture",
    "check",
    "kind_of",
    "lock",
    "own_plan",
    "parameters_of",
    "present_keys",
    "procedure_of",
    "rerun",
    "rerun_all",
    "resume",
]
