"""The report of the oscilloscope procedure: a self-contained page, the same bytes for the same input."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest

import numpy as np

from ..core.data import Frame
from ..core.errors import UsageError
from ..core.numbers import aligned
from ..core.provenance import Provenance
from ..io import ReseauDesign
from ..procedures.oscilloscope import PhotoI, PhotoII, PhotoIII, StillStandard
from .factors import FACTORS, factor_by_factor
from .photo_i import photo_i_section
from .photo_ii import photo_ii_section
from .photo_iii import photo_iii_section
from .tables import Row
from .template import rendered
from .truth import Comparison, Factor, Pair


def oscilloscope_report(
    first: PhotoI,
    reseau: ReseauDesign,
    second: PhotoII | None = None,
    test_object: ReseauDesign | None = None,
    third: Sequence[PhotoIII] = (),
    *,
    frames: Sequence[Frame | None] = (),
    title: str = "Correction of oscilloscope images",
    provenance: Provenance | None = None,
    truth: Comparison | None = None,
    camera: Row | None = None,
) -> str:
    """Render the report of the steps of the procedure that were done.

    Parameters
    ----------
    first : PhotoI
        The camera and its film, group A.
    reseau : ReseauDesign
        The reseau.
    second : PhotoII, optional
        The ultrasonic instrument, group B; without it the page shows PHOTO I alone.
    test_object : ReseauDesign, optional
        Its rods; needed with `second`.
    third : sequence of PhotoIII
        Bodies measured with both corrections.
    frames : sequence of Frame or None
        The photographs in their order; a missing one or None omits its picture.
    title : str
        Heading of the page.
    provenance : Provenance, optional
        Inputs, options, version.
    truth : Comparison, optional
        Comparison with the truth of a simulator.
    camera : dict, optional
        A camera calibrated in another session; see :func:`~reseau.report.camera.camera_section`.

    Returns
    -------
    str
        An HTML page without any external resource and without clock times.

    Raises
    ------
    UsageError
        When a correction was read from a file and has no residuals, or a photograph lacks those before it.

    Examples
    --------
    >>> from reseau.core.data import ImagePoints
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> from reseau.optics import RationalPolynomial
    >>> from reseau.procedures.oscilloscope import photo_i
    >>> reseau = regular_reseau(4, 4, 10.0, Mark(shape="disk", size=1.0))
    >>> seen = ImagePoints.with_sigma(reseau.ids, reseau.xy * [9.0, -9.0] + [800.0, 600.0], 0.01)
    >>> first = photo_i(seen, reseau, model=RationalPolynomial.affine()).required()
    >>> "<h1>Scope 7</h1>" in oscilloscope_report(first, reseau, title="Scope 7")
    True
    """
    if (second is None) != (test_object is None):
        raise UsageError("needs its test object, and the test object needs PHOTO II", where="PHOTO II")
    if third and second is None:
        raise UsageError("needs PHOTO II before it", where="PHOTO III")
    pictures = [frame for _, frame in zip_longest(range(2 + len(third)), frames)]
    one = photo_i_section(first, reseau, pictures[0], None if truth is None else truth.camera)
    more: Row = {"two": None, "three": [], "factors": None}
    if second is not None and test_object is not None:
        more = _of_the_instrument(second, test_object, third, pictures[1:], truth)
    facts = (provenance or Provenance()).to_dict()
    return rendered(
        "oscilloscope.html.j2",
        title=title,
        reseau=reseau,
        unit=reseau.unit,
        one=one,
        provenance=facts,
        camera=camera,
        **more,
    )


def applied_report(
    rods: ReseauDesign,
    third: Sequence[PhotoIII] = (),
    again: StillStandard | None = None,
    *,
    frames: Sequence[Frame | None] = (),
    title: str = "Oscilloscope images corrected",
    provenance: Provenance | None = None,
) -> str:
    """Render the report of photographs that were corrected by a stored calibration.

    Parameters
    ----------
    rods : ReseauDesign
        The test object of the calibration.
    third : sequence of PhotoIII
        Bodies measured by the calibration.
    again : StillStandard, optional
        The test of the calibration by a new PHOTO II.
    frames : sequence of Frame or None
        The photographs of `third`; where one is missing or None the page has no picture of it.
    title : str
        Heading of the page.
    provenance : Provenance, optional
        Inputs, options, version.

    Returns
    -------
    str
        An HTML page without any external resource and without clock times.

    Examples
    --------
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> rods = regular_reseau(4, 4, 10.0, Mark(shape="rod", size=1.0))
    >>> "<h1>Scope 7</h1>" in applied_report(rods, title="Scope 7")
    True
    """
    pictures = [frame for _, frame in zip_longest(range(len(third)), frames)]
    return rendered(
        "applied.html.j2",
        title=title,
        two={"design": rods},
        three=[
            photo_iii_section(found, rods, frame, None)
            for found, frame in zip(third, pictures[: len(third)], strict=True)
        ],
        again=None if again is None else _test_of_the_calibration(again, rods.unit),
        provenance=(provenance or Provenance()).to_dict(),
    )


def _test_of_the_calibration(again: StillStandard, unit: str) -> Row:
    """Everything the section about a test of the calibration shows."""
    test = again.test
    rod, length = test.largest
    verdict = "still hold" if test.holds else "no longer hold"
    return {
        "summary": [
            (str(len(test.names)), "", "rods compared"),
            (f"{test.p:.3f}", "", f"probability: the coefficients {verdict}"),
            (f"{length:.3g}", unit, f"largest change, at rod {rod}"),
        ],
        "object": "the same test object" if test.same_object else "another test object",
        "verdict": verdict,
        "statistic": f"{test.statistic:.1f}",
        "degrees": test.degrees,
        "critical": f"{test.critical:.1f}",
        "alpha": f"{test.alpha:g}",
        "p": f"{test.p:.3f}",
        "largest": f"{length:.3g} {unit}",
        "rod": rod,
        "notes": tuple(note.text for note in again.notes),
    }


def _of_the_instrument(
    second: PhotoII,
    test_object: ReseauDesign,
    third: Sequence[PhotoIII],
    pictures: Sequence[Frame | None],
    truth: Comparison | None,
) -> Row:
    """The sections on PHOTO II and III, and the table of remaining errors."""
    rods, bodies, factors = (None, (), ()) if truth is None else (truth.rods, truth.bodies, truth.factors)
    return {
        "two": photo_ii_section(second, test_object, pictures[0], rods),
        "three": [
            photo_iii_section(found, test_object, frame, body)
            for found, frame, body in zip_longest(third, pictures[1 : 1 + len(third)], bodies[: len(third)])
        ],
        "factors": _factors(factors or factor_by_factor(second, test_object)),
    }


def _factors(factors: Sequence[Factor]) -> Row:
    """The table of remaining errors: titles of the columns with content, and rows of cells."""
    columns: list[tuple[str, str, list[Pair | None]]] = [
        ("rods", "compared with their design", [factor.rods for factor in factors]),
        ("check rods", "compared with their design", [factor.check for factor in factors]),
        ("points of PHOTO III", "compared with the truth", [factor.body for factor in factors]),
        ("the same,", "rods free of error", [factor.ideal for factor in factors]),
    ]
    shown = [column for column in columns if any(pair is not None for pair in column[2])]
    cells = [
        aligned([float("nan") if pair is None else pair[k] for pair in pairs], 3)
        for *_, pairs in shown
        for k in range(2)
    ]
    rows = [(factor.name, *row) for factor, *row in zip(factors, *cells, strict=True)]
    return {
        "groups": [(name, what) for name, what, _ in shown],
        "rows": rows,
        "left": _left(factors),
    }


def _left(factors: Sequence[Factor]) -> tuple[str, str] | None:
    """Remaining error of a point after both corrections, and the same with rods free of error."""
    both = next((factor for factor in factors if factor.name == FACTORS[3]), None)
    if both is None or both.body is None or both.ideal is None:
        return None
    return f"{np.hypot(*both.body):.3f}", f"{np.hypot(*both.ideal):.3f}"
