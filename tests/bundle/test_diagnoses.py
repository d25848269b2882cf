"""Broken networks: each is reported with its cause and the offending element, with and without rejection.

A network that is fine is not accused.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.bundle import Network, Options, Result, ResultDocument, adjust_network
from reseau.core.data import Array
from reseau.core.failure import Code
from reseau.exchange import read_network
from reseau.optics.poses import matrix_to_vector

from . import networks

DATA = Path(os.environ.get("RESEAU_DATA", "../shared/data")) / "independent" / "networks"

Change = Callable[[Network, np.random.Generator], Network]


def block(**more: Any) -> Network:
    """Eight images of forty points, six of them control; noise of the given sigma."""
    return networks.world(**({"images": 8, "points": 40, "control": 6} | more)).noisy(1)


def free_block() -> Network:
    """The same without control, with four scale bars of 1 mm."""
    world = networks.world(images=8, points=40, control=0, datum="free")
    pairs = np.array([[0, 1], [2, 3], [4, 5], [6, 7]])
    length = np.linalg.norm(world.xyz[pairs[:, 1]] - world.xyz[pairs[:, 0]], axis=1)
    bars = np.column_stack([length, np.full(4, 1e-3)])
    return replace(world.noisy(1), distance_of=pairs, distance=bars)


def opencv() -> Network:
    return block(cameras=(networks.camera("opencv"),))


def observed() -> Network:
    """Control points with sigmas of 1 mm."""
    world = networks.world(images=8, points=40, control=10)
    sigma = np.where(world.network.sigma == 0, 1e-3, np.nan)
    return replace(world.noisy(1), sigma=sigma)


def one_station() -> Network:
    rng = np.random.default_rng(5)
    xyz = rng.uniform(-3, 3, (80, 3)) + np.array([0, 0, 9.0])
    targets = np.array([[x, y, 9.0] for x in (-1.5, 0, 1.5) for y in (-1.0, 1.0)])
    return networks.seen_from(np.zeros((6, 3)), targets, xyz, 0)


def parallel_views() -> Network:
    """A relief seen by a long lens from far stations, all with the same view."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-1, 1, (60, 3)) * [3.0, 2.0, 0.5]
    centres = np.array([[x, y, 12.0] for x in (-1.0, 0.0, 1.0) for y in (-0.6, 0.6)])
    return networks.seen_from(centres, centres * [1, 1, 0], xyz, 0, networks.camera(free=("c",)))


def long_lens() -> Network:
    """A nearly flat relief seen at right angles from stations along a line, by a lens of ten degrees."""
    rng = np.random.default_rng(8)
    xyz = rng.uniform(-1, 1, (60, 3)) * [3.0, 1.5, 0.3]
    centres = np.array([[x, 0.2 * (-1) ** k, 24.0] for k, x in enumerate((-2.0, -1.0, 0.0, 1.0, 2.0))])
    camera = networks.camera(free=())
    values = camera.values.copy()
    values[0], values[1:] = 40.0, 0.0
    return networks.seen_from(centres, centres * [1, 1, 0], xyz, 0, replace(camera, values=values))


def plane(tilt: float, seed: int = 6) -> Network:
    """A plane of 36 known points seen by six images at a given tilt."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 6), np.linspace(-0.8, 0.8, 6)))
    xyz = np.column_stack([x, y, 0 * x])
    angle = np.linspace(0, 2 * np.pi, 6, endpoint=False) + seed
    height = np.array([3.0, 3.3, 3.6, 3.1, 3.5, 3.8])
    centres = np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), height], axis=1)
    aim = centres * [1, 1, 0]
    centres = centres + np.tan(tilt) * height[:, None] * np.stack(
        [np.cos(angle), np.sin(angle), 0 * angle], axis=1
    )
    return networks.seen_from(centres, aim, xyz, 36, networks.camera(free=("c", "x0", "y0", "K1")))


def uneven_board() -> Network:
    """A plane of held points that are all a little off: the board is not as designed, no point is wrong."""
    network, rng = plane(0.5), np.random.default_rng(11)
    return replace(network, xyz=network.xyz + rng.normal(0, 4e-4, network.xyz.shape))


def copied(network: Network, image: int, onto: int) -> Network:
    """The image points of an image given to another one as well."""
    rows = np.flatnonzero(network.image_of == image)
    every = np.concatenate([np.flatnonzero(network.image_of != onto), rows])
    image_of = np.concatenate([network.image_of[network.image_of != onto], np.full(len(rows), onto)])
    return replace(
        network,
        image_of=image_of,
        point_of=network.point_of[every],
        xy=network.xy[every],
        cov=network.cov[every],
    )


def with_control(network: Network, factor: Array) -> Network:
    return replace(network, xyz=network.xyz * factor)


def camera_of(network: Network, **values: float) -> Network:
    camera = network.cameras[0]
    at = {camera.names.index(name): value for name, value in values.items()}
    new = np.array([at.get(k, value) for k, value in enumerate(camera.values)])
    return replace(network, cameras=(replace(camera, values=new),))


def with_camera(network: Network, **more: Any) -> Network:
    return replace(network, cameras=(replace(network.cameras[0], **more),))


def moved(network: Network, row: int, by: tuple[float, float]) -> Network:
    xy = network.xy.copy()
    xy[row] += by
    return replace(network, xy=xy)


def mapped(network: Network, function: Callable[[Array], Array], image: int | None = None) -> Network:
    own = np.ones(len(network.xy), dtype=bool) if image is None else network.image_of == image
    return replace(network, xy=np.where(own[:, None], function(network.xy), network.xy))


def point_moved(network: Network, j: int, by: tuple[float, float, float]) -> Network:
    xyz = network.xyz.copy()
    xyz[j] += by
    return replace(network, xyz=xyz)


def renamed(network: Network, rows: Array, point: int) -> Network:
    """Rays given the name of another point; those of this point in the same images are removed."""
    images = set(network.image_of[rows].tolist())
    twice = (network.point_of == point) & np.isin(network.image_of, list(images))
    point_of = network.point_of.copy()
    point_of[rows] = point
    return replace(network, point_of=point_of).select(~twice)


def posed(network: Network) -> Network:
    """The network with the poses of its adjustment given."""
    fit = adjust_network(network).required().fit
    return replace(network, x0=fit.values.x0.copy(), rotation=matrix_to_vector(fit.values.rotation))


def stations_in(network: Network, unit: float) -> Network:
    """The network with its projection centres given in another unit."""
    given = posed(network)
    return replace(given, x0=given.x0 / unit)


def bar(network: Network, k: int, factor: float) -> Network:
    distance = network.distance.copy()
    distance[k, 0] *= factor
    return replace(network, distance=distance)


def control_on_a_line(network: Network) -> Network:
    xyz = network.xyz.copy()
    fit = adjust_network(network).required().fit
    order = np.argsort(fit.values.xyz[:, 0])
    xyz[:] = np.nan
    keep = order[[0, 20]]
    xyz[keep] = fit.values.xyz[keep]
    sigma = np.where(np.isnan(xyz), np.nan, 0.0)
    return replace(network, xyz=xyz, sigma=sigma)


@dataclass(frozen=True)
class Broken:
    """A broken network, the code and words of its diagnosis."""

    name: str
    network: Callable[[], Network]
    code: Code
    words: tuple[str, ...]
    rejecting: bool = True


def row_of(network: Network, image: int, k: int = 3) -> int:
    return int(np.flatnonzero(network.image_of == image)[k])


BROKEN = [
    # Units and values that no camera has.
    Broken(
        "pitch in micrometres",
        lambda: with_camera(block(), pitch_mm=(10.0, 10.0)),
        Code.IMPLAUSIBLE,
        ("pixel size of 10 mm", "micrometres"),
    ),
    Broken(
        "pitch of 3.45 micrometres",
        lambda: with_camera(block(), pitch_mm=(3.45, 3.45)),
        Code.IMPLAUSIBLE,
        ("pixel size of 3.45 mm", "micrometres"),
    ),
    Broken(
        "pitch in metres",
        lambda: with_camera(block(), pitch_mm=(1e-5, 1e-5)),
        Code.IMPLAUSIBLE,
        ("pixel size of 1e-05 mm", "metres"),
    ),
    Broken(
        "principal distance in metres",
        lambda: camera_of(block(), c=0.008),
        Code.IMPLAUSIBLE,
        ("principal distance of 0.008 mm", "metres"),
    ),
    Broken(
        "principal distance in micrometres",
        lambda: camera_of(block(), c=8000.0),
        Code.IMPLAUSIBLE,
        ("principal distance of 8000 mm",),
    ),
    Broken(
        "focal length in millimetres",
        lambda: camera_of(opencv(), fx=8.0, fy=8.0),
        Code.IMPLAUSIBLE,
        ("focal length of 8 px",),
    ),
    Broken(
        "one focal length in millimetres",
        lambda: camera_of(opencv(), fy=8.0),
        Code.IMPLAUSIBLE,
        ("focal length of 8 px",),
    ),
    Broken(
        "projection centres in thousands",
        lambda: stations_in(block(), 1e3),
        Code.IMPLAUSIBLE,
        ("projection centres X0 are 1000 times too small", "points (m)"),
    ),
    Broken(
        "projection centres in thousandths",
        lambda: stations_in(block(), 1e-3),
        Code.IMPLAUSIBLE,
        ("projection centres X0 are 1000 times too large",),
    ),
    Broken(
        "principal point in pixels",
        lambda: camera_of(block(), x0=319.5, y0=239.5),
        Code.IMPLAUSIBLE,
        ("principal point", "x0 319.5 mm", "pixels"),
    ),
    Broken(
        "principal point left at zero",
        lambda: camera_of(opencv(), cx=0.0, cy=0.0),
        Code.IMPLAUSIBLE,
        ("principal point", "cx 0 px"),
    ),
    Broken(
        "distortion in another unit",
        lambda: camera_of(block(), K1=2.0),
        Code.IMPLAUSIBLE,
        ("distortion", "K1"),
    ),
    Broken(
        "image coordinates in millimetres",
        lambda: mapped(block(), lambda xy: (xy - [319.5, 239.5]) * [0.01, -0.01]),
        Code.IMPLAUSIBLE,
        ("all image coordinates are within", "millimetres"),
    ),
    Broken(
        "normalised image coordinates",
        lambda: mapped(block(), lambda xy: xy / [640, 480]),
        Code.IMPLAUSIBLE,
        ("all image coordinates are within", "normalised"),
    ),
    Broken(
        "rotations in degrees",
        lambda: (lambda n: replace(n, rotation=np.degrees(n.rotation)))(posed(block())),
        Code.IMPLAUSIBLE,
        ("rotation vectors", "degrees"),
    ),
    # Coordinates outside the image.
    Broken(
        "a decimal point lost",
        lambda: mapped_row(block(), 2, 10.0),
        Code.OUTSIDE,
        ("in image i2", "outside the image"),
    ),
    Broken(
        "a negative coordinate",
        lambda: (lambda n: moved(n, row_of(n, 3), (-900.0, 0.0)))(block()),
        Code.OUTSIDE,
        ("in image i3", "outside the image"),
    ),
    Broken(
        "width and height exchanged",
        lambda: with_camera(block(), width=480, height=640),
        Code.OUTSIDE,
        ("exchanged",),
    ),
    Broken(
        "x and y exchanged", lambda: mapped(block(), lambda xy: xy[:, ::-1]), Code.OUTSIDE, ("exchanged",)
    ),
    Broken(
        "one of two distances in centimetres",
        lambda: (
            lambda n: replace(
                n, distance_of=n.distance_of[:2], distance=n.distance[:2] * [[1.0, 1.0], [0.1, 1.0]]
            )
        )(free_block()),
        Code.DOUBTFUL_CONTROL,
        ("contradict each other", "cannot be decided"),
    ),
    Broken(
        "control in metres, declared as millimetres",
        lambda: (lambda n: replace(n, xyz=n.xyz * 1e-3))(block()),
        Code.IMPLAUSIBLE,
        ("nearer than the principal distance",),
    ),
    # Geometry that determines nothing.
    Broken("parallel views", parallel_views, Code.NOT_IDENTIFIED, ("tilted against each other",)),
    Broken("one station", one_station, Code.ONE_STATION, ("from one station",)),
    Broken(
        "a plane seen frontally", lambda: plane(0.0), Code.FRONTAL, ("frontally", "c cannot be separated")
    ),
    Broken(
        "a plane seen frontally, one image",
        lambda: (lambda n: n.select(n.image_of == 0))(plane(0.0)),
        Code.FRONTAL,
        ("frontally",),
    ),
    Broken(
        "points of an image on a line",
        lambda: on_a_line(block(), 4),
        Code.COLLINEAR,
        ("image i4", "one line"),
    ),
    Broken(
        "no datum",
        lambda: replace(block(control=0), datum="control"),
        Code.NO_DATUM,
        ("scale", "not determined"),
    ),
    Broken(
        "two control points",
        lambda: control_on_a_line(block()),
        Code.NO_DATUM,
        ("rotation", "not determined"),
    ),
    Broken(
        "an image with two points",
        lambda: (lambda n: n.select((n.image_of != 6) | (np.cumsum(n.image_of == 6) < 3)))(block()),
        Code.TOO_FEW_POINTS,
        ("image i6 has fewer than three points",),
    ),
    Broken(
        "three control points and no other",
        lambda: (lambda n: n.select(n.point_of < 3))(block()),
        Code.TOO_FEW_POINTS,
        ("three leave up to four poses",),
    ),
    Broken(
        "a point in one image",
        lambda: (lambda n: n.select((n.point_of != 20) | (n.image_of == n.image_of[n.point_of == 20][0])))(
            block()
        ),
        Code.RANK_DEFECT,
        ("single ray", "p20"),
    ),
    Broken(
        "two blocks without a common point",
        lambda: two_blocks(free_block()),
        Code.TOO_FEW_POINTS,
        ("points in common with the others: another network; left out",),
    ),
    # Scale bars and control.
    *[
        Broken(
            f"scale bar {k} times {f}",
            lambda k=k, f=f: bar(free_block(), k, f),
            Code.DOUBTFUL_CONTROL,
            ("distance", f"p{2 * k} to p{2 * k + 1}"),
        )
        for k, f in ((0, 1.02), (2, 1.1), (3, 1000.0))
    ],
    Broken(
        "control point with a typing error",
        lambda: point_moved(block(), 2, (1.0, 0, 0)),
        Code.DOUBTFUL_CONTROL,
        ("p2",),
    ),
    Broken(
        "height of a control point wrong",
        lambda: point_moved(block(), 4, (0, 0, -0.3)),
        Code.DOUBTFUL_CONTROL,
        ("p4",),
    ),
    Broken(
        "control points exchanged",
        lambda: exchanged(block(), 1, 3),
        Code.DOUBTFUL_CONTROL,
        ("p1 and p3 look exchanged",),
    ),
    Broken(
        "some control points in feet",
        lambda: with_control(block(control=10), np.where(np.arange(40) < 4, 1 / 0.3048, 1.0)[:, None]),
        Code.DOUBTFUL_CONTROL,
        ("p0, p1, p2, p3", "factor of 3.28", "another unit"),
    ),
    Broken(
        "heights of control counted downwards",
        lambda: with_control(block(control=10), np.array([1.0, 1.0, -1.0])),
        Code.DOUBTFUL_CONTROL,
        ("mirrored",),
    ),
    Broken(
        "a copy of an image",
        lambda: copied(block(), 2, 5),
        Code.INCONSISTENT,
        ("i2 and i5 have exactly the same",),
    ),
    Broken(
        "image coordinates from the middle",
        lambda: mapped(block(), lambda xy: xy - [319.5, 239.5]),
        Code.OUTSIDE,
        ("from the middle of the image",),
    ),
    Broken(
        "mirrored control",
        lambda: (lambda n: replace(n, xyz=n.xyz * [1, -1, 1]))(block()),
        Code.DOUBTFUL_CONTROL,
        ("mirrored",),
    ),
    Broken(
        "y upwards",
        lambda: mapped(block(), lambda xy: [0, 479] + xy * [1, -1]),
        Code.DOUBTFUL_CONTROL,
        ("mirrored",),
    ),
    *[
        Broken(
            f"observed control point p{j} off by {d}",
            lambda j=j, d=d: point_moved(observed(), j, d),
            Code.DOUBTFUL_CONTROL,
            (f"p{j} ", "contradict"),
        )
        for j, d in ((3, (0.02, 0.0, 0.0)), (7, (0.0, 0.05, 0.05)))
    ],
    Broken(
        "two observed control points wrong",
        lambda: point_moved(point_moved(observed(), 2, (0.05, 0, 0)), 8, (0, 0, 0.04)),
        Code.DOUBTFUL_CONTROL,
        ("p2 ", "p8 ", "contradict"),
    ),
    # Observations and names.
    Broken(
        "a gross error",
        lambda: (lambda n: moved(n, row_of(n, 5, 8), (25.0, 0.0)))(block()),
        Code.GROSS_ERRORS,
        ("in image i5",),
        False,
    ),
    Broken(
        "an image of another scene", lambda: mapped(block(), scrambled, 5), Code.TOO_FEW_POINTS, ("image i5",)
    ),
    Broken(
        "an image mirrored",
        lambda: mapped(block(), lambda xy: [639, 0] + xy * [-1, 1], 2),
        Code.GROSS_ERRORS,
        ("image i2",),
    ),
    Broken(
        "one name for two points",
        lambda: (lambda n: renamed(n, np.flatnonzero((n.point_of == 30) & (n.image_of % 2 == 0)), 31))(
            block()
        ),
        Code.GROSS_ERRORS,
        ("p31",),
        False,
    ),
    # Held values and sigmas.
    Broken(
        "principal distance held at a wrong value",
        lambda: camera_of(with_camera(block(), free=()), c=8.6),
        Code.INCONSISTENT,
        ("held parameters", "c 8.6"),
    ),
    Broken(
        "distortion held at zero",
        lambda: camera_of(with_camera(block(), free=("c",)), K1=0.0, K2=0.0),
        Code.INCONSISTENT,
        ("held parameters", "K1 0"),
    ),
    Broken(
        "principal point held at a wrong place",
        lambda: camera_of(with_camera(block(), free=("c",)), x0=0.5),
        Code.INCONSISTENT,
        ("held parameters", "x0 0.5"),
    ),
    Broken(
        "pixels wider than said",
        lambda: camera_of(with_camera(block(), free=("c", "x0", "y0", "K1", "K2")), B1=0.05),
        Code.INCONSISTENT,
        ("held parameters", "B1 0.05"),
    ),
    Broken(
        "sigmas a thousand times too small",
        lambda: (lambda n: replace(n, cov=n.cov * 1e-6))(block()),
        Code.SIGMAS_DOUBTFUL,
        ("times what input sigmas say",),
    ),
    Broken(
        "sigmas a hundred times too large",
        lambda: (lambda n: replace(n, cov=n.cov * 1e4))(block()),
        Code.SIGMAS_DOUBTFUL,
        ("% of what input sigmas say",),
    ),
    Broken(
        "given rotations in the other sense",
        lambda: (lambda n: replace(n, rotation=-n.rotation))(posed(block())),
        Code.INCONSISTENT,
        ("given orientation",),
    ),
]


def mapped_row(network: Network, image: int, factor: float) -> Network:
    xy = network.xy.copy()
    xy[row_of(network, image), 0] *= factor
    return replace(network, xy=xy)


def scrambled(xy: Array) -> Array:
    return np.random.default_rng(9).uniform([0, 0], [639, 479], xy.shape)


def on_a_line(network: Network, image: int) -> Network:
    own = network.image_of == image
    xy = network.xy.copy()
    xy[own] = [50, 60] + np.linspace(0, 1, int(own.sum()))[:, None] * [500, 300]
    return replace(network, xy=xy)


def two_blocks(network: Network) -> Network:
    """Images 0 to 3 see the first half of the points, the others the rest."""
    return network.select((network.image_of < 5) == (network.point_of < 25))


def exchanged(network: Network, a: int, b: int) -> Network:
    xyz = network.xyz.copy()
    xyz[[a, b]] = xyz[[b, a]]
    return replace(network, xyz=xyz)


def exchanged_poses(network: Network, a: int, b: int) -> Network:
    x0, rotation = network.x0.copy(), network.rotation.copy()
    x0[[a, b]], rotation[[a, b]] = x0[[b, a]], rotation[[b, a]]
    return replace(network, x0=x0, rotation=rotation)


def said(network: Network, outliers: Any) -> tuple[str, set[Code]]:
    found = adjust_network(network, Options(outliers=outliers))
    if isinstance(found, Result):
        return " | ".join(map(str, found.warnings)), {remark.code for remark in found.warnings}
    return found.reason, {found.code}


def few_rays(network: Network, points: range) -> Network:
    """Only the first two rays of some points."""
    nth = np.array([np.sum(network.point_of[:k] == j) for k, j in enumerate(network.point_of)])
    return network.select(~np.isin(network.point_of, points) | (nth < 2))


@pytest.mark.parametrize("outliers", ["keep", pytest.param("reject", marks=pytest.mark.slow)])
def test_misidentified_control_points_are_all_named_and_no_others(outliers: str) -> None:
    """Five of twelve, two of them in two rays only, one with a gross error of a ray of another beside."""
    world = networks.world(images=8, points=40, control=12)
    sound = replace(world.noisy(1), sigma=np.where(world.network.sigma == 0, 1e-3, np.nan))
    sound = few_rays(sound, range(0, 12, 3))
    wrong = {1: (0.5, 0, 0), 3: (0, 0.2, 0.1), 4: (0, 0, -0.8), 6: (0.3, 0, 0.3), 8: (-0.1, 0.1, 0)}
    network = sound
    for j, by in wrong.items():
        network = point_moved(network, j, by)
    network = moved(network, int(np.flatnonzero(network.point_of == 5)[0]), (8.0, 5.0))
    text, codes = said(network, outliers)
    assert Code.DOUBTFUL_CONTROL in codes
    named = text[text.index("the control points") : text.index("contradict the other observations")]
    assert {int(name) for name in re.findall(r"p(\d+) ", named)} == set(wrong)
    if outliers == "reject":
        result = adjust_network(network, Options(outliers="reject")).required()
        off = result.fit.values.xyz - world.xyz
        assert np.linalg.norm(off[list(wrong)], axis=1).max() < 0.02
        assert 0.8 < result.sigma0 < 1.15


def test_a_control_point_is_not_accused_for_one_of_its_rays() -> None:
    """A ray that is far off displaces the point in a free network; its coordinates are right."""
    network = block()
    row = int(np.flatnonzero((network.point_of == 3) & (network.image_of == 3))[0])
    text, codes = said(moved(network, row, (-900.0, 0.0)), "reject")
    assert Code.OUTSIDE in codes
    assert Code.DOUBTFUL_CONTROL not in codes, text


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="needs the networks of RESEAU_DATA")
def test_of_control_points_that_no_test_reaches_it_is_said() -> None:
    """Published network of eight misidentified points; the images contradict one of them."""
    text, _ = said(read_network(DATA / "riva5.json"), "keep")
    first, _, rest = text.partition("contradicts the other observations; ")
    assert first.rpartition("the control point ")[2].startswith("802 (by 0.6")
    unchecked = rest.partition(" cannot be found")[0]
    assert all(f"{name} (up to" in unchecked for name in ("677", "678", "831", "832", "836"))
    assert "840 (of any size)" in unchecked
    assert "at the others (675, 809, 804, " in rest


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="needs the networks of RESEAU_DATA")
def test_misidentified_points_that_are_not_named_agree_with_the_images() -> None:
    """Without the eight as control, the images place two of them within 3 sigma of where they are given."""
    given, found = (read_network(DATA / f"riva5{name}.json") for name in ("", "good"))
    fit = adjust_network(found).required().fit
    for name, furthest in (("675", 0.02), ("809", 0.03)):
        j, k = given.points.index(name), found.points.index(name)
        off = fit.values.xyz[k] - given.xyz[j]
        cov = fit.cofactors.points[k] * fit.variance + np.diag(given.sigma[j] ** 2)
        assert np.linalg.norm(off) < furthest
        assert off @ np.linalg.solve(cov, off) < 3**2


# Cases of more than a second; all of them, with and without rejection, are run by `make slow`.
SLOW = {
    "pitch in micrometres", "pitch of 3.45 micrometres", "principal distance in metres",
    "focal length in millimetres", "one focal length in millimetres", "principal point in pixels",
    "control points exchanged", "mirrored control", "y upwards", "control point with a typing error",
    "height of a control point wrong", "an image mirrored", "one name for two points",
    "a decimal point lost", "one station", "x and y exchanged", "heights of control counted downwards",
    "an image of another scene", "some control points in feet", "a negative coordinate",
    "pixels wider than said", "parallel views", "given rotations in the other sense",
}  # fmt: skip


@pytest.mark.parametrize("outliers", ["keep", pytest.param("reject", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=pytest.mark.slow if c.name in SLOW else (), id=c.name) for c in BROKEN],
)
def test_a_broken_network_is_reported_with_its_cause(case: Broken, outliers: str) -> None:
    if outliers == "reject" and not case.rejecting:
        pytest.skip("what is rejected is listed with the result")
    text, codes = said(case.network(), outliers)
    for word in case.words:
        assert word in text
    assert case.code in codes


ACCUSING = {
    Code.IMPLAUSIBLE,
    Code.OUTSIDE,
    Code.ONE_STATION,
    Code.FRONTAL,
    Code.COLLINEAR,
    Code.DOUBTFUL_CONTROL,
    Code.INCONSISTENT,
    Code.GROSS_ERRORS,
}


@pytest.mark.parametrize(
    "sound",
    [
        block,
        free_block,
        opencv,
        observed,
        lambda: plane(0.5),
        uneven_board,
        long_lens,
        lambda: plane(0.15),
        lambda: posed(block()),
        lambda: exchanged_poses(posed(block()), 1, 5),
        lambda: camera_of(block(), c=7.0),
        lambda: with_camera(plane(0.0), free=()),
        lambda: block(cameras=(networks.camera("brown-image"),)),
        lambda: block(images=20, points=60),
    ],
)
@pytest.mark.parametrize("outliers", ["keep", pytest.param("reject", marks=pytest.mark.slow)])
def test_a_sound_network_is_not_accused(sound: Callable[[], Network], outliers: str) -> None:
    text, codes = said(sound(), outliers)
    assert not codes & ACCUSING, text


def test_what_parallel_views_do_not_determine_has_no_standard_deviation() -> None:
    """Whether they do is judged elsewhere; here it is said that they do not."""
    result = adjust_network(networks.world(images=8, points=30, datum="free", control=0).noisy(1)).required()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Result, "perspective", lambda self, c: (0.5, False))
        (camera,) = result.cameras.values()
        assert np.isnan(camera.sigma[list(camera.parameters).index("c")])
        assert np.isfinite(camera.sigma[list(camera.parameters).index("x0")])
        assert "c not determined" in repr(camera)
        assert np.isnan(result.images.sigma).all()
        assert np.isnan(result.points.sigma).all()
        assert ResultDocument.of(result).cameras[0].parameters["c"].sigma is None


def test_control_on_a_line_is_named() -> None:
    network = networks.world(images=8, points=40, control=6, seed=3).noisy(1)
    xyz = network.xyz.copy()
    truth = networks.world(images=8, points=40, control=6, seed=3)
    line = np.column_stack([np.linspace(-0.8, 0.8, 6), np.zeros(6), np.zeros(6)])
    xy = network.xy.copy()
    for i in range(8):
        rows = np.flatnonzero((network.image_of == i) & (network.point_of < 6))
        seen = networks.image_points(network.cameras[0], truth.rotation[i], truth.x0[i], line)
        xy[rows] = seen[network.point_of[rows]]
    xyz[:6] = line
    _, codes = said(replace(network, xyz=xyz, xy=xy), "keep")
    assert Code.COLLINEAR in codes


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "code"), [(True, Code.SIGMAS_DOUBTFUL), (False, Code.GROSS_ERRORS)])
def test_standard_deviations_of_x_and_y_compete_with_gross_errors(wrong: bool, code: Code) -> None:
    """Standard deviations in x that are too small by a hundred, or right ones and some gross errors in x."""
    network, rng = networks.world(images=8, points=40, control=6, seed=3).noisy(1), np.random.default_rng(0)
    xy, cov = network.xy.copy(), network.cov * [[1e-4, 1e-2], [1e-2, 1.0]]
    if not wrong:
        cov = network.cov * [[1.0, 10.0], [10.0, 100.0]]
        xy[:, 1] += 0.5 * rng.normal(size=len(xy))
        xy[::30, 0] += 3.0
    result = adjust_network(replace(network, xy=xy, cov=cov)).required()
    codes = [remark.code for remark in result.warnings]
    assert codes[0] is code
    assert (Code.GROSS_ERRORS in codes) is not wrong
