"""Remarks on rods that were not measured: declined is not missing."""

from __future__ import annotations

import numpy as np

from reseau.core.data import ImagePoints
from reseau.core.failure import Code
from reseau.designs import regular_reseau
from reseau.io import Mark
from reseau.procedures.oscilloscope import photo_i, photo_ii
from reseau.refine.remarks import of_the_object

_RODS = regular_reseau(5, 4, 18.0, Mark(shape="rod", size=1.0))
_RESEAU = regular_reseau(5, 4, 20.0, Mark(shape="disk", size=4.0))


def _imaged(xy: np.ndarray, ids: tuple[str, ...]) -> ImagePoints:
    return ImagePoints.with_sigma(ids, [700, 500] + xy * [8, -8], 0.02)


def test_a_declined_row_of_rods_is_not_called_missing():
    first = photo_i(_imaged(_RESEAU.xy, _RESEAU.ids), _RESEAU)
    low = _RODS.xy[:, 1].min()
    kept = np.flatnonzero(_RODS.xy[:, 1] > low)
    names = tuple(_RODS.ids[i] for i in kept)
    images = _imaged(_RODS.xy[kept], names)
    instrument = photo_ii(images, _RESEAU, _RODS, first.camera).instrument
    lost = [name for name in _RODS.ids if name not in names]
    (missing,) = of_the_object(instrument, images, _RODS)
    assert missing.code is Code.NOT_FOUND
    assert "is missing" in missing.text
    (all_declined,) = of_the_object(instrument, images, _RODS, dict.fromkeys(lost, "too uncertain"))
    assert all_declined.code is Code.DECLINED
    assert "all were declined (too uncertain)" in all_declined.text
    (some,) = of_the_object(instrument, images, _RODS, dict.fromkeys(lost[:2], "too uncertain"))
    assert "2 of 5 were declined (too uncertain), the others are missing" in some.text
