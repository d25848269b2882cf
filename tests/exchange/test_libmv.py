"""Problems of libmv hold cameras, points and markers as Ceres' example reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reseau.core.errors import FormatError
from reseau.exchange.libmv import read_libmv
from reseau.exchange.networks import read_foreign

from .scene import residuals, scene

INTERIOR = [900.0, 400.0, 300.0, -0.1, 0.02, 0.003, 0.001, -0.002]


def problem(order: str = "<", space: bytes = b"P") -> bytes:
    """The scene as a problem; image numbers have gaps, and one marker is of a track that is not there."""
    f, cx, cy, k1, k2, k3, p1, p2 = INTERIOR
    every = scene()
    x, y = np.moveaxis(every.directions, -1, 0)
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = f * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
    v = f * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)) + cy

    def floats(values: object) -> bytes:
        return np.asarray(values, order + "f4").tobytes()

    def number(*values: int) -> bytes:
        return np.array(values, order + "i4").tobytes()

    content = (b"v" if order == "<" else b"V") + space + floats(INTERIOR) + number(len(every.x0))
    for i, (turn, x0) in enumerate(zip(every.turns, every.x0, strict=True)):
        content += number(10 * i) + floats(turn.T) + floats(-turn @ x0)
    content += number(len(every.xyz))
    for j, point in enumerate(every.xyz):
        content += number(3 * j) + floats(point)
    content += number(u.size + 1) + number(0, 1) + floats([5, 5])
    for i, j in np.ndindex(*u.shape):
        content += number(10 * i, 3 * j) + floats([u[i, j], v[i, j]])
    return content


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_problem_of_either_byte_order_is_the_network(order: str, tmp_path: Path) -> None:
    (tmp_path / "problem.bin").write_bytes(problem(order))
    network = read_foreign(tmp_path / "problem.bin")
    assert network.images == ("0", "10", "20", "30")
    assert network.points[1] == "3"
    assert len(network.xy) == 60
    # Numbers of 32 bit.
    assert np.abs(residuals(network)).max() < 1e-3
    assert network.cameras[0].parameters["cx"] == 399.5


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (problem()[:-1], "ends too early"),
        (problem() + b"1", "has 1 bytes after the last marker"),
        (problem(space=b"N"), "in normalised coordinates"),
        (b"vP" + np.zeros(1, "<f4").tobytes() + problem()[6:], "has the focal length 0"),
        (problem().replace(np.array([10], "<i4").tobytes(), bytes(4)), "has an image twice"),
    ],
)
def test_broken_problems_are_refused_in_one_line(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "problem.bin").write_bytes(content)
    with pytest.raises(FormatError, match=message):
        read_libmv(tmp_path / "problem.bin")
