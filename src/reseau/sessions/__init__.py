"""Sessions: acquisitions that are measured live and can be computed again from the archive.

Names are imported when they are first used: scans of film need neither archive nor bench.

Examples
--------
Compute the results of a session again, in a program:

>>> from reseau import sessions
>>> from reseau.archive import Archive
>>> with Archive.open("archive") as archive:                            # doctest: +SKIP
...     all(each.same for each in sessions.rerun(archive.session("monday")))
True
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazily

if TYPE_CHECKING:
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

__getattr__ = lazily(
    __name__,
    {
        "CORNERS": ".kinds",
        "FramesParameters": ".parameters",
        "KINDS": ".kinds",
        "OF_FILES": ".kinds",
        "PhotographsParameters": ".parameters",
        "SCENE": ".kinds",
        "SessionKind": ".kinds",
        "SessionParameters": ".parameters",
        "TestfieldParameters": ".parameters",
        "begin": ".conducting",
        "calibration_of": ".conducting",
        "capture": ".conducting",
        "check": ".conducting",
        "input_option": ".kinds",
        "kind_of": ".kinds",
        "lock": ".conducting",
        "parameters_of": ".conducting",
        "present_keys": ".parameters",
        "procedure_of": ".conducting",
        "rerun": ".conducting",
        "rerun_all": ".conducting",
        "resume": ".conducting",
    },
)
