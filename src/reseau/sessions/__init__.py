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
from .kinds import CORNERS, KINDS, OF_FILES, SCENE, SessionKind, input_option, kind_of
from .parameters import (
    FramesParameters,
    PhotographsParameters,
    SessionParameters,
    TestfieldParameters,
    present_keys,
)

__all__ = [
    "CORNERS",
    "KINDS",
    "OF_FILES",
    "SCENE",
    "FramesParameters",
    "PhotographsParameters",
    "SessionKind",
    "SessionParameters",
    "TestfieldParameters",
    "begin",
    "calibration_of",
    "capture",
    "check",
    "input_option",
    "kind_of",
    "lock",
    "parameters_of",
    "present_keys",
    "procedure_of",
    "rerun",
    "rerun_all",
    "resume",
]
