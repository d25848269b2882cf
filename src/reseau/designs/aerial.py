"""Aerial cameras that are known by name: their fiducial marks, from published calibration reports.

Coordinates are nominal ones. The standard deviation is that of single cameras about them, with the offset of
the origin of their reports, as the median of absolute deviations × 1.4826 gives it. Marks are named as in the
reports of the USGS: 1 to 4 lower left, upper right, upper left, lower right; 5 to 8 left, right, top, bottom,
with the data strip on the left. The forms are measured in published pictures: their sizes are right within
some percent.

Sources: C. Donovan's transcription of the USGS Camera Calibration Reports (github.com/iamdonovan/
fiducial_markers, data/combined_reports.csv, commit caa2bea1) for Wild RC 8, RC 10 and Zeiss RMK A; for the
RMK TOP report OSL/2432 of 1998 in it (RMK TOP 30, 144163), and the certificate of the RMK TOP 15, 151967, in
the module zeissRmkTop of OrientAL (TU Wien); for the RC 20 data/RC20.txt (lens 13180) of
github.com/Behrouz-al/semi-automatic-fiducial-mark-extraction, whose coordinates differ from those of the
RC 10 by 6 µm at most; it does not say what form its marks have. Forms: the pictures of the documentation of
spymicmac (cameras.rst, commit dba7a677), in proportion to the cross of the RC 8 in the module wildRc8 of
OrientAL; for Zeiss the modules zeissRmkA and zeissRmkTop.

Of the Jena LMK 2000 one report is published (OSL/1551 of 1990, camera 271826C, same transcription): its
coordinates are the nominal ones to 7 µm, and the standard deviation is that of the other cameras. The form of
its marks is not published: there is a design for each form, to be chosen by what a photograph shows.
"""

from __future__ import annotations

from ..core.errors import UsageError
from ..io import FiducialDesign, FiducialMark, FiducialPoint, MarkPart

_CORNERS = {"1": (-1, -1), "2": (1, 1), "3": (-1, 1), "4": (1, -1)}
_MIDDLES = {"5": (-1, 0), "6": (1, 0), "7": (0, 1), "8": (0, -1)}

_USGS = "nominal, beside {} USGS calibration reports"
_LMK = "nominal, beside USGS report OSL/1551; the form of the marks is not published"
_CAMERAS: dict[str, tuple[str, float, tuple[str, float] | None, tuple[str, float] | None, str]] = {
    "wild-rc8": (
        "Wild RC 5, RC 8, RC 9: crosses in the corners",
        0.012, ("cross", 106.0), None, _USGS.format("317"),
    ),
    "wild-rc8-crosses": (
        "Wild RC 8: crosses in the corners and at the sides",
        0.010, ("cross", 106.0), ("cross", 110.0), _USGS.format("170"),
    ),
    "wild-rc8-circles": (
        "Wild RC 8: crosses in the corners, circles with crosses at the sides",
        0.010, ("cross", 106.0), ("circle", 110.0), _USGS.format("170"),
    ),
    "wild-rc10": (
        "Wild RC 10: circles with crosses",
        0.009, ("circle", 106.0), ("circle", 110.0), _USGS.format("410"),
    ),
    "wild-rc20": (
        "Wild RC 20: marks as of the RC 10",
        0.009, ("circle", 106.0), ("circle", 110.0), "nominal, beside the file of one camera",
    ),
    "zeiss-rmk-a": (
        "Zeiss RMK A: dots at the sides",
        0.013, None, ("dot", 113.0), _USGS.format("55"),
    ),
    "zeiss-rmk-top": (
        "Zeiss RMK TOP: dots in circles with crosses",
        0.012, ("top", 113.0), ("top", 113.0), "nominal, beside USGS report OSL/2432 and a certificate",
    ),
} | {
    f"jena-lmk-{words.split()[0]}": (
        f"Jena LMK 2000, if its marks are {words}",
        0.012, (mark, 110.0), (mark, 112.0), _LMK,
    )
    for mark, words in (("cross", "crosses"), ("circle", "circles with crosses"), ("dot", "dots"))
}  # fmt: skip
"""Name, standard deviation, mark and distance (mm) in the corners and at the sides, source."""


def aerial_cameras() -> dict[str, FiducialDesign]:
    """Designs of the fiducial marks of aerial cameras by their names.

    Examples
    --------
    >>> list(aerial_cameras())
    ['wild-rc8', 'wild-rc8-crosses', 'wild-rc8-circles', 'wild-rc10', 'wild-rc20', 'zeiss-rmk-a', ...]
    """
    return {name: aerial_camera(name) for name in _CAMERAS}


def aerial_camera(name: str) -> FiducialDesign:
    """The fiducial marks of an aerial camera, with nominal coordinates.

    Parameters
    ----------
    name : str
        Name of the camera, as in :func:`aerial_cameras`.

    Raises
    ------
    UsageError
        When the name is not known.

    Examples
    --------
    >>> camera = aerial_camera("wild-rc10")
    >>> camera.name, camera.ids[:2], camera.xy[:2].tolist()
    ('Wild RC 10: circles with crosses', ('1', '2'), [[-106.0, -106.0], [106.0, 106.0]])
    """
    if name not in _CAMERAS:
        raise UsageError(
            f"no camera has the name {name!r}", where="fiducial marks", do=f"known are {', '.join(_CAMERAS)}"
        )
    title, sigma, corners, middles, source = _CAMERAS[name]
    points, marks = [], {}
    for places, marked in ((_CORNERS, corners), (_MIDDLES, middles)):
        if marked is None:
            continue
        mark, away = marked
        margin, *parts = _marks()[mark]
        marks[mark] = FiducialMark(polarity="bright", parts=tuple(parts), margin=margin)
        # The arms of crosses in the corners point along the diagonals.
        turn = 45.0 if places is _CORNERS else 0.0
        points += [
            FiducialPoint(id=key, x=away * x, y=away * y, sigma=sigma, mark=mark, turn_deg=turn)
            for key, (x, y) in places.items()
        ]
    return FiducialDesign(name=title, source=source, marks=marks, points=tuple(points))


def _marks() -> dict[str, tuple[float, MarkPart, *tuple[MarkPart, ...]]]:
    """Margins and parts of marks."""
    return {
        "cross": (0.6, MarkPart(shape="cross", size=3.86, line_width=0.1, gap=0.7)),
        "circle": (
            0.5,
            MarkPart(shape="ring", size=1.9, line_width=0.18),
            MarkPart(shape="cross", size=3.45, line_width=0.05, gap=0.57),
        ),
        "top": (
            0.4,
            MarkPart(shape="disk", size=0.155),
            MarkPart(shape="ring", size=1.85, line_width=0.3),
            MarkPart(shape="cross", size=2.15, line_width=0.155, gap=0.62),
        ),
        "dot": (0.7, MarkPart(shape="disk", size=0.2)),
    }
