"""One world: the camera images the testfield as the turntable moves it over its real protocol."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from reseau.core.data import Array, Frame
from reseau.core.errors import UsageError
from reseau_drivers.turntable import zaber
from reseau_sims import FieldBench, World
from reseau_sims.laboratory import Laboratory, Room
from reseau_sims.serving import FaultyConnection, PtyServer, Server, TcpServer, ZaberChain

from ..montecarlo import slowly

AXES = {"tilt": (1, 1), "roll": (1, 2), "camera_roll": (2, 1), "z": (3, 1)}
PX = 57.5 / 0.027
MIDDLE = 119.5


@contextmanager
def moving(kind: type[Server]) -> Iterator[tuple[Laboratory, ZaberChain, Any]]:
    """A laboratory whose table is moved over a real protocol."""
    chain = ZaberChain([2, 1, 1])
    laboratory = Laboratory(World.standard(seed=5), FieldBench(seed=5, bend_mm=0.0), room=Room())
    for motor in chain.motors.values():
        motor.speed = 1e6
    for name, key in AXES.items():
        laboratory.attach(name, lambda key=key: chain.position(*key) / 1000)  # type: ignore[misc]
    with kind(lambda: FaultyConnection(chain)) as server:
        yield laboratory, chain, server


def turned(angle: float, x: Array, y: Array) -> tuple[Array, Array]:
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return c * x - s * y, s * x + c * y


def predicted(laboratory: Laboratory, start: Any, tilt: float, roll: float, camera: float, z: float) -> Array:
    """Images of the targets (n, 2), by hand: turned in the mount, tilted, moved away, seen, turned."""
    x, y = laboratory.field.design.xy.T
    x, y = turned(roll, x, y)
    depth, x = -math.sin(math.radians(tilt)) * x, math.cos(math.radians(tilt)) * x
    # The camera as it was set up, looking along −z with y up; the image has y down.
    x0, y0, distance = start.x0
    delta = math.degrees(math.atan2(start.matrix[1, 0], start.matrix[0, 0]))
    scale = PX / (distance + z - depth)
    u, v = turned(camera + delta, scale * (x - x0), -scale * (y - y0))
    return np.column_stack([MIDDLE + u, MIDDLE + v])


def centre_of_target(frame: Frame, near: Array) -> Array:
    """Centre of gravity (2,) of what is dark within 4 px."""
    column, row = np.rint(near).astype(int)
    window = frame.pixels[row - 4 : row + 5, column - 4 : column + 5].astype(float)
    dark = np.clip(0.75 * np.median(frame.pixels) - window, 0, None)
    offset = np.arange(-4.0, 5.0)
    return np.array([column + dark.sum(0) @ offset / dark.sum(), row + dark.sum(1) @ offset / dark.sum()])


@pytest.mark.slow
@pytest.mark.client("zaber-motion", "Zaber chain, TCP", "poses of the testfield before the camera")
def test_zaber_motion_moves_the_testfield_that_the_camera_sees() -> None:
    ascii_ = pytest.importorskip("zaber_motion.ascii", reason="zaber-motion is not installed")
    with (
        moving(TcpServer) as (laboratory, chain, server),
        ascii_.Connection.open_tcp("127.0.0.1", server.port) as line,
    ):
        axes = {name: line.get_device(d).get_axis(a) for name, (d, a) in AXES.items()}
        for axis in axes.values():
            axis.home()
        start = laboratory.field_truth().pose
        for tilt, roll, camera, z in (
            (0, 0, 0, 0),
            (30, 0, 0, 0),
            (30, 40, 0, 0),
            (30, 40, 90, 0),
            (30, 40, 90, 150),
        ):
            for name, value in zip(AXES, (tilt, roll, camera, z), strict=True):
                axes[name].move_absolute(1000 * value)
            frame, truth = laboratory.expose("testfield"), laboratory.field_truth()
            by_hand = predicted(laboratory, start, tilt, roll, camera, z)
            np.testing.assert_allclose(truth.xy, by_hand, rtol=0, atol=1e-6)
            # Small targets far from any line, so that nothing else is dark around them.
            targets = laboratory.field.design.targets
            alone = [k for k in _alone(by_hand) if targets.shape[k] in ("circle", "disk", "square")]
            found = np.array([centre_of_target(frame, by_hand[k]) for k in alone])
            assert len(alone) >= 10
            off = np.hypot(*(found - by_hand[alone]).T)
            assert np.median(off) < 0.15, (tilt, roll, camera, z, off)
        assert chain.violations == []


def _alone(xy: Array) -> list[int]:
    """Targets (by number) well inside the frame whose next neighbour is far."""
    gap = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    np.fill_diagonal(gap, np.inf)
    inside = ((xy > 12) & (xy < 227)).all(axis=1)
    return [int(k) for k in np.flatnonzero(inside & (gap.min(axis=1) > 5.0))]


@pytest.mark.slow
def test_our_driver_moves_it_over_a_serial_line_and_a_frame_is_what_was_predicted() -> None:
    with moving(PtyServer) as (laboratory, chain, server):
        plans = {name: {"device": d, "axis": a, "per_unit": 1000.0} for name, (d, a) in AXES.items()}
        with zaber("table", server.address, axes=plans, settings={"speed": 1000.0}) as table:
            for axis in plans:
                table.home(axis)
            before = laboratory.expose("testfield").pixels.astype(float)
            again = laboratory.expose("testfield").pixels.astype(float)
            table.move("tilt", 45.0)
            table.move("roll", 90.0)
            after = laboratory.expose("testfield").pixels.astype(float)
        assert laboratory.axes == pytest.approx({"tilt": 45.0, "roll": 90.0, "camera_roll": 0.0, "z": 0.0})
        # Two frames of one pose differ by their noise alone (46 dB); after a move nothing is where it was.
        noise = float(np.std(again - before)) / math.sqrt(2)
        assert 0.5 < noise < 3.0
        assert float(np.std(after - before)) > 10 * noise
        station, bench = laboratory._moved()
        left = after - bench.light(station)
        assert float(np.std(left)) < 1.5 * noise
        assert chain.violations == []


def test_a_moving_table_is_imaged_at_its_current_position() -> None:
    time = [0.0]
    chain = ZaberChain([1], clock=lambda: time[0])
    laboratory = Laboratory(World.standard(seed=5), room=Room(), clock=lambda: time[0])
    laboratory.attach("tilt", lambda: chain.position(1, 1) / 1000)
    motor = chain.motors[1, 1]
    motor.home()
    time[0] = 10.0
    assert laboratory.axes["tilt"] == 0.0
    motor.go(40_000.0)
    # Nobody asks the table; 20 000 steps a second are its speed.
    time[0] += 1.0
    assert laboratory.axes["tilt"] == pytest.approx(20.0)
    assert laboratory.field_truth().pose.x0[0] != 0.0


@pytest.mark.slow
def test_light_exposure_and_gain_act_as_specified_and_saturate() -> None:
    time = [0.0]
    laboratory = Laboratory(World.standard(seed=1), room=Room(light_per_hour=-0.1), clock=lambda: time[0])
    bright = float(np.median(laboratory.expose("testfield").pixels))
    assert np.median(laboratory.expose("testfield", light=0.5).pixels) == pytest.approx(bright / 2, abs=1.0)
    assert np.median(laboratory.expose("testfield", gain=0.25).pixels) == pytest.approx(bright / 4, abs=1.0)
    assert np.median(laboratory.expose("testfield", light=10.0).pixels) == 255
    time[0] = 3600.0
    assert np.median(laboratory.expose("testfield").pixels) == pytest.approx(0.9 * bright, abs=1.0)
    time[0] = 36000.0 * 3
    assert laboratory.expose("testfield").pixels.max() < 20


def test_the_camera_drifts_with_time() -> None:
    time = [0.0]
    laboratory = Laboratory(
        World.standard(seed=1), room=Room(drift_mm_per_hour=(1.0, 0.0, 0.0)), clock=lambda: time[0]
    )
    before = laboratory.field_truth().xy
    time[0] = 2 * 3600.0
    moved = laboratory.field_truth().xy - before
    # 2 mm to the right at 5 m: the testfield goes to the left by 2 · 57.5 / 0.027 / 5000 px.
    assert np.median(moved, axis=0) == pytest.approx([-2 * PX / 5000, 0.0], abs=0.02)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_laboratory_and_frames() -> None:
    one, two = (Laboratory(World.standard(seed=8), clock=lambda: 0.0) for _ in range(2))
    assert one.room == two.room != Laboratory(World.standard(seed=9)).room
    assert one.expose("testfield").sha256 == two.expose("testfield").sha256
    assert one.expose("testfield").sha256 != one.expose("testfield").sha256


@pytest.mark.parametrize("tilt", [90.0, 400.0, *slowly(75.0, 89.0, 180.0)])
def test_every_reachable_position_gives_a_frame(tilt: float) -> None:
    laboratory = Laboratory(World.standard(seed=1))
    laboratory.attach("tilt", lambda: tilt)
    assert laboratory.expose("testfield").pixels.shape == (240, 240)


def test_an_unknown_axis_is_refused() -> None:
    with pytest.raises(UsageError, match="tilt, roll"):
        Laboratory(World.standard(seed=1)).attach("yaw", lambda: 0.0)
