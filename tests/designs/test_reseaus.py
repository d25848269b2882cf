"""Regular reseaus: names, coordinates, and refused designs."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.designs import coded_sheet, regular_reseau, standard_reseau
from reseau.io import Mark, ReseauDesign

DISK = Mark(shape="disk", size=2.0)


def test_rows_are_lettered_beyond_z() -> None:
    grid = regular_reseau(2, 29, 5.0, DISK)
    assert grid.ids[-6:] == ("AA1", "AA2", "AB1", "AB2", "AC1", "AC2")
    np.testing.assert_allclose(grid.xy.mean(axis=0), 0, rtol=0, atol=1e-12)
    assert grid.xy[0, 1] == 70.0


def test_the_standard_reseau_covers_its_screen_and_can_be_written() -> None:
    grid = standard_reseau()
    assert len(grid.points) == 165
    np.testing.assert_array_equal(np.abs(grid.xy).max(axis=0), [70.0, 50.0])
    at = dict(zip(grid.ids, grid.xy.tolist(), strict=True))
    assert (at[grid.origin or ""], at[grid.axis or ""]) == ([0.0, 0.0], [70.0, 0.0])
    assert ReseauDesign.parse(grid.to_json(), where="standard") == grid


@pytest.mark.parametrize(
    ("columns", "rows", "pitch", "mark", "options", "complaint"),
    [
        (1, 5, 10.0, DISK, {}, "1 × 5 marks"),
        (5, 5, -1.0, DISK, {}, "5 × 5 marks"),
        (5, 5, 1.5, DISK, {}, "do not fit a pitch"),
        (5, 5, 10.0, Mark(shape="disk"), {}, "do not fit"),
        (5, 5, 10.0, Mark(shape="cross", size=3.0), {}, "line width"),
        (5, 5, 10.0, DISK, {"origin": "Z9"}, "origin: 'Z9' is not a mark"),
        (5, 5, 10.0, DISK, {"origin": "A1", "axis": "A1"}, "must differ"),
    ],
)
def test_impossible_reseaus_are_refused(
    columns: int, rows: int, pitch: float, mark: Mark, options: dict[str, str], complaint: str
) -> None:
    with pytest.raises(UsageError, match=complaint):
        regular_reseau(columns, rows, pitch, mark, **options)  # type: ignore[arg-type]


def test_the_rings_of_a_sheet_differ_under_rotation_and_reflection() -> None:
    rings = coded_sheet(10, 10, 25.0).rings
    assert rings is not None
    degrees = np.arange(720) / 2 + 0.25
    dark = [
        np.any([np.mod(degrees - start, 360) < end - start for start, end in sectors], axis=0)
        for sectors in rings.sectors.values()
    ]
    for k, code in enumerate(dark):
        seen = [np.roll(way, 180 * quarter) for way in (code, code[::-1]) for quarter in range(4)]
        # Four of twelve sectors, from itself turned or reflected and from the others anyhow.
        for other in [*seen[1:], *(np.asarray(each) for each in dark[:k] + dark[k + 1 :])]:
            assert (code != other).mean() >= 4 / 12 - 1e-9
        for other in dark[:k] + dark[k + 1 :]:
            assert min((way != other).mean() for way in seen) >= 4 / 12 - 1e-9


def test_an_impossible_sheet_is_refused() -> None:
    with pytest.raises(UsageError, match="no room for four rings"):
        coded_sheet(3, 9, 25.0)
    with pytest.raises(UsageError, match="do not fit rings"):
        coded_sheet(9, 9, 25.0, size=13.0)
    with pytest.raises(UsageError, match="cannot have"):
        coded_sheet(9, 9, 0.0)
