"""Copies of one photograph, and photographs of one pose."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from reseau.core.data import Frame
from reseau.core.failure import Failure
from reseau.designs import board
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.copies import copies_among
from reseau.procedures.target_measurement import measurer_of

from ..measure.board_pictures import picture

CHESS = board("chess", 7, 6, 24.0)


def saved_again(frame: Frame, quality: int, name: str) -> Frame:
    """The frame as JPEG of some quality."""
    data = cv2.imencode(".jpg", frame.pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return Frame(np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)), 255.0, name)


@pytest.mark.slow
def test_copies_count_once_and_exposures_of_one_pose_do_not() -> None:
    frames = [replace(picture(CHESS, seed=k)[0], name=f"{k}.png") for k in range(3)]
    frames += [replace(frames[0], name="copied.png"), saved_again(frames[1], 90, "saved.jpg")]
    measured = {}
    for frame in frames:
        found = measurer_of(CHESS)(frame)
        assert not isinstance(found, Failure)
        measured[frame.name] = found.points
    assert copies_among(measured) == {"copied.png": "0.png", "saved.jpg": "1.png"}


def test_exposures_of_one_pose_are_hardly_ever_taken_for_copies() -> None:
    rng, wrong = np.random.default_rng(1), 0
    found = measurer_of(CHESS)(picture(CHESS)[0])
    assert not isinstance(found, Failure)
    points = found.points
    sigma = np.sqrt(np.diagonal(points.cov, axis1=1, axis2=2))
    for _ in range(300):
        pair = [replace(points, xy=points.xy + sigma * rng.normal(size=sigma.shape)) for _ in range(2)]
        wrong += bool(copies_among(dict(zip("ab", pair, strict=True))))
    # A mean square of 60 squares of normal variates is below 0.4 in less than one of a thousand.
    assert wrong <= 2


def test_copies_are_named_in_one_note() -> None:
    frames = [
        replace(picture(CHESS, tilt, turn)[0], name=f"{turn:.0f}.png") for tilt, turn in ((9, 5), (30, 95))
    ]
    copies = [replace(frame, name=f"copy-{frame.name}") for frame in frames]
    done = calibrate_camera([*frames, *copies], CHESS, measurer_of(CHESS))
    assert isinstance(done, Failure)
    assert done.reason.startswith("2 images (5.png, 95.png) show the target, 3 are needed")
    assert "; copy-5.png: a copy of 5.png; copy-95.png: a copy of 95.png" in done.reason
