"""The report of the oscilloscope procedure: a page that stands alone, same to the byte for the same input."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import count, zip_longest

import jinja2

from ..data import Frame
from ..errors import UsageError
from ..formats import ReseauDesign
from ..procedures.oscilloscope import PhotoI, PhotoII, PhotoIII
from ..provenance import Provenance
from .factors import factor_by_factor
from .numbers import aligned
from .photo_i import photo_i_section
from .photo_ii import photo_ii_section
from .photo_iii import photo_iii_section
from .tables import Row
from .truth import Comparison, Factor, Pair

__all__ = ["oscilloscope_report"]


def oscilloscope_report(
    first: PhotoI,
    reseau: ReseauDesign,
    second: PhotoII | None = None,
    test_object: ReseauDesign | None = None,
    third: Sequence[PhotoIII] = (),
    *,
    frames: Sequence[Frame | None] = (),
    title: str = "Oscilloscope images refined",
    provenance: Provenance | None = None,
    truth: Comparison | None = None,
) -> str:
    """Render the report of as much of the procedure as was done.

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
        Bodies measured by both.
    frames : sequence of Frame or None
        The photographs in their order, PHOTO I, PHOTO II, and those of `third`; where one is lacking or None
        the page has no picture of it.
    title : str
        Its heading.
    provenance : Provenance, optional
        Inputs, options, version.
    truth : Comparison, optional
        What a simulator knows.

    Returns
    -------
    str
        An HTML page without any external resource and without clock times.

    Raises
    ------
    UsageError
        When a correction was read from a file: it has no residuals to show; when a photograph is given
        without those before it.
    """
    if (second is None) != (test_object is None):
        raise UsageError("and its test object go together", where="PHOTO II")
    if third and second is None:
        raise UsageError("needs PHOTO II before it", where="PHOTO III")
    known = () if truth is None else truth.bodies
    pictures = [frame for _, frame in zip_longest(range(2 + len(third)), frames)]
    one = photo_i_section(first, reseau, pictures[0], None if truth is None else truth.camera)
    two, three, factors = None, [], None
    if second is not None and test_object is not None:
        two = photo_ii_section(second, test_object, pictures[1], None if truth is None else truth.rods)
        three = [
            photo_iii_section(found, test_object, frame, body)
            for found, frame, body in zip_longest(third, pictures[2 : 2 + len(third)], known[: len(third)])
        ]
        found_factors = truth.factors if truth is not None and truth.factors else ()
        factors = _factors(found_factors or factor_by_factor(second, test_object))
    return _render(
        title=title,
        reseau=reseau,
        unit=reseau.unit,
        one=one,
        two=two,
        three=three,
        factors=factors,
        provenance=(provenance or Provenance()).to_dict(),
        simulated=truth is not None,
        figure=partial(next, count(1)),
        table=partial(next, count(1)),
    )


def _render(**content: object) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("reseau.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("oscilloscope.html.j2").render(content)


def _factors(factors: Sequence[Factor]) -> Row:
    """The table factor by factor: titles of the columns that have anything, and rows of cells."""
    columns: list[tuple[str, str, list[Pair | None]]] = [
        ("rods", "against their design", [factor.rods for factor in factors]),
        ("check rods", "against their design", [factor.check for factor in factors]),
        ("points of PHOTO III", "against the truth", [factor.body for factor in factors]),
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
        "body": any(factor.body is not None for factor in factors),
        "ideal": any(factor.ideal is not None for factor in factors),
    }
