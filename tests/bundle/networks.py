"""Synthetic networks whose truth is known: points before a ring of cameras, observed with noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reseau.bundle import Camera, Network
from reseau.bundle.network.camera import Additional
from reseau.bundle.solver.approximation import approximate
from reseau.bundle.solver.problem import BundleProblem
from reseau.bundle.solver.unknowns import Unknowns
from reseau.bundle.solver.values import Values
from reseau.core.data import Array
from reseau.optics import OpenCV, RationalPolynomial
from reseau.optics.composition import Chain, Similarity
from reseau.optics.displays import wong_display
from reseau.optics.poses import Pose, matrix_to_vector, project
from reseau.optics.refraction import RefractedRays, Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex, window_parameters

BROWN = (8.0, 0.03, -0.02, 2e-3, -3e-5, 0.0, 4e-5, -3e-5, 2e-4, -1e-4)
OPENCV = (810.0, 805.0, 321.0, 238.0, -0.2, 0.05, 4e-4, -3e-4, 0.01, 0.0, 0.0, 0.0)
RATIONAL = (810.0, 805.0, 321.0, 238.0, 0.2, -0.05, 4e-4, -3e-4, 0.01, 0.4, 0.03, -0.005)


@dataclass(frozen=True, eq=False)
class World:
    """A network without noise, and the truth of it."""

    network: Network
    rotation: Array
    x0: Array
    xyz: Array

    def noisy(self, seed: int, factor: float = 1.0) -> Network:
        """The network observed with noise of its covariances; observed coordinates and distances too."""
        network, rng = self.network, np.random.default_rng(seed)
        root = np.linalg.cholesky(network.cov)
        noise = (root @ rng.normal(size=(*network.xy.shape, 1)))[:, :, 0]
        observed = np.where(network.observed, network.sigma, 0.0)
        more = rng.normal(size=network.xyz.shape) * np.nan_to_num(observed)
        distance = network.distance.copy()
        distance[:, 0] += factor * distance[:, 1] * rng.normal(size=len(distance))
        return replace(
            network, xy=network.xy + factor * noise, xyz=network.xyz + factor * more, distance=distance
        )

    def problem(self, network: Network | None = None, **options: Any) -> BundleProblem:
        """The problem begun at the truth."""
        network = self.network if network is None else network
        unknowns = Unknowns.of(network, np.ones(len(network.images), dtype=bool))
        start = Values.of_cameras(unknowns, self.rotation, self.x0, self.xyz)
        return BundleProblem(network, start, self.xyz, **options)


def by_itself(network: Network, **options: Any) -> BundleProblem:
    """The problem with approximate values found from the network alone."""
    found = approximate(network)
    unknowns = Unknowns.of(network, np.isfinite(found.x0).all(axis=1))
    start = Values.of_cameras(unknowns, found.rotation, found.x0, found.xyz)
    return BundleProblem(network, start, found.xyz, **options)


def looking_at(x0: Array, target: Array, roll: float) -> Array:
    """Rotation of a camera at x0 that looks at a point."""
    z = (target - x0) / np.linalg.norm(target - x0)
    x = np.cross([0.0, 0.0, 1.0], z)
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * x + s * y, -s * x + c * y, z])


def camera(model: str = "brown-object", free: tuple[str, ...] | None = None, **more: Any) -> Camera:
    """A camera of 640×480 pixels of 0.01 mm."""
    if model.startswith("opencv"):
        values = np.array(RATIONAL if model == "opencv-8" else OPENCV)
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
        return Camera(
            "cam", 640, 480, (0.01, 0.01), "opencv", values, names if free is None else free, **more
        )
    names = ("c", "x0", "y0", "K1", "K2", "P1", "P2", "B1", "B2")
    options = {"side": model.removeprefix("brown-"), **more.pop("options", {})}
    return Camera(
        "cam",
        640,
        480,
        (0.01, 0.01),
        "brown",
        np.array(BROWN),
        names if free is None else free,
        options,
        **more,
    )


def world(
    images: int = 6,
    points: int = 25,
    datum: Any = "control",
    cameras: tuple[Camera, ...] | None = None,
    sigma_px: float = 0.05,
    control: int = 5,
    seed: int = 0,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    size: float = 1.0,
) -> World:
    """Points in a box of 2 m (times `size`), images on a ring around and above it; the first are control."""
    rng = np.random.default_rng(seed)
    cameras = cameras or (camera(),)
    xyz = size * rng.uniform(-1, 1, (points, 3)) * [1.0, 1.0, 0.4]
    angle = np.linspace(0, 2 * np.pi, images, endpoint=False)
    x0 = np.stack([3.6 * np.cos(angle), 3.6 * np.sin(angle), 2.0 + 0.6 * np.sin(3 * angle)], axis=1)
    rotation = np.stack([looking_at(x, np.zeros(3), 0.8 * k) for k, x in enumerate(x0)])
    camera_of = np.arange(images) % len(cameras)
    image_of, point_of = (a.ravel() for a in np.meshgrid(np.arange(images), np.arange(points), indexing="ij"))
    xy = np.zeros((len(image_of), 2))
    for i in range(images):
        rows = image_of == i
        xy[rows] = image_points(cameras[camera_of[i]], rotation[i], x0[i], xyz)
    inside = np.isfinite(xy).all(axis=1) & (xy > 0).all(axis=1) & (xy < [639, 479]).all(axis=1)
    sigma = np.full((points, 3), np.nan)
    sigma[:control] = 0.0
    moved = np.asarray(shift)
    network = Network(
        cameras=cameras,
        images=tuple(f"i{k}" for k in range(images)),
        camera_of=camera_of,
        x0=np.full((images, 3), np.nan),
        rotation=np.full((images, 3), np.nan),
        points=tuple(f"p{k}" for k in range(points)),
        xyz=np.where(sigma == 0, xyz + moved, np.nan),
        sigma=sigma,
        role=tuple("control" if k < control else "tie" for k in range(points)),
        image_of=image_of[inside],
        point_of=point_of[inside],
        xy=xy[inside],
        cov=np.tile(np.array([[1.0, 0.3], [0.3, 1.5]]) * sigma_px**2, (int(inside.sum()), 1, 1)),
        distance_of=np.zeros((0, 2), dtype=np.intp),
        distance=np.zeros((0, 2)),
        datum=datum,
        datum_points=np.ones(points, dtype=bool),
        groups=tuple(f"g{k % 2}" for k in range(images)),
        files=(None,) * images,
        unit="m",
    )
    return World(network, rotation, x0 + moved, xyz + moved)


def image_points(cam: Camera, rotation: Array, x0: Array, xyz: Array) -> Array:
    """Image coordinates (px) by :mod:`reseau.optics`, an implementation of its own."""
    return project(mapping_of(cam), Pose(matrix_to_vector(rotation), x0), xyz).xy


def seen_from(
    centres: Array, targets: Array, xyz: Array, control: int, own: Camera | None = None, seed: int = 4
) -> Network:
    """Images from given places towards given targets."""
    own = own or camera()
    base = world(images=len(centres), points=len(xyz), control=control).network
    turn = [looking_at(x0, t, 0.0) for x0, t in zip(centres, targets, strict=True)]
    xy = np.stack([image_points(own, r, x0, xyz) for r, x0 in zip(turn, centres, strict=True)])
    with np.errstate(invalid="ignore"):
        inside = (xy > 0).all(axis=2) & (xy < [639, 479]).all(axis=2)
    image, point = np.nonzero(inside)
    noise = np.random.default_rng(seed).normal(0, 0.05, (len(image), 2))
    known = np.arange(len(xyz))[:, None] < control
    return replace(
        base, cameras=(own,), image_of=image, point_of=point, xy=xy[inside] + noise,
        cov=np.tile(0.0025 * np.eye(2), (len(image), 1, 1)), xyz=np.where(known, xyz, np.nan),
        datum="control" if control else "free",
    )  # fmt: skip


def mapped(cam: Camera) -> Camera:
    """The same camera by its mapping of :mod:`reseau.optics`, which is not compiled."""
    return replace(cam, model="mapping", mapping=mapping_of(cam), values=np.array(mapping_of(cam).values))


def mapping_of(cam: Camera) -> Any:
    """The camera as :mod:`reseau.optics` has it."""
    return cam.bare_mapping()


def wong() -> Camera:
    """A lens and Wong's display behind it, all its terms free but those a lens has too."""
    lens = OpenCV([800.0, 800.0, 0.0, 0.0, -0.1, 0.0, 0.0, 0.0, 0.0])
    chain = Chain(lens, Chain(wong_display(), Similarity([320.0, 240.0, 1.0, 0.0])), ("lens.", "display."))
    values = np.array(chain.values)
    return Camera("chain", 640, 480, (0.01, 0.01), "mapping", values, (
        "lens.fx", "lens.k1", chain.names[10], chain.names[-1]), mapping=chain)  # fmt: skip


def polynomial() -> Camera:
    """Rays imaged by a pinhole, then by a polynomial whose terms are data."""
    bent = RationalPolynomial(
        {"k": {"X": "x3 + xy2", "Y": "y3 + yx2"}, "s": {"X": "y", "Y": ""}, "q": {"X": "x2", "Y": "xy"}},
        [3e-7, 2e-3, 1e-5], {"X": "x", "Y": "y"},
    )  # fmt: skip
    pinhole = OpenCV([800.0, 800.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    chain = Chain(pinhole, Chain(bent, Similarity([320.0, 240.0, 1.0, 0.0])), ("lens.", ""))
    free = ("lens.fx", *(name for name in chain.names if name.rpartition(".")[2] in "ksq"))
    return Camera("poly", 640, 480, (0.01, 0.01), "mapping", np.array(chain.values), free, mapping=chain)


def with_ebner(per: Any, base_mm: float = 1.2) -> Camera:
    """A camera with Ebner's parameters beside c, x0, y0."""
    return camera(free=(), additional=Additional(base_mm, True, per))


# The cameras of :func:`world` are some 4 m from points within 1 m of the origin; all windows are between.
WINDOWS: dict[str, tuple[Window, ...]] = {
    "plane port": (
        Window("port", "plane", "camera", {"distance": 0.05, "thickness": 0.025}, ("air", "glass", "water")),
    ),
    "dome": (
        Window("dome", "sphere", "camera", {"X": 0.004, "Z": 0.006, "radius": 0.1, "thickness": 0.01},
               ("air", "glass", "water")),
    ),
    "surface of the water": (
        Window("surface", "plane", "object", {"distance": -1.3}, ("air", "water"), direction=(0, 0, -1)),
    ),
    "tank wall": (
        Window("wall", "plane", "object", {"distance": -1.3, "thickness": 0.02}, ("air", "glass", "water"),
               direction=(0, 0, -1)),
    ),
    "round tank": (
        Window("tank", "cylinder", "object", {"radius": 1.8, "thickness": 0.02}, ("air", "glass", "water"),
               camera_side="outside"),
    ),
    "port before a round tank": (
        Window("port", "plane", "camera", {"distance": 0.05, "thickness": 0.025}, ("air", "glass", "air")),
        Window("tank", "cylinder", "object", {"radius": 1.8, "thickness": 0.02}, ("air", "glass", "water"),
               camera_side="outside"),
    ),
}  # fmt: skip


def refracted(
    base: World, kind: str, free: tuple[str, ...] | None = None, sigma: dict[str, float] | None = None
) -> World:
    """The same world seen through windows; `free` are the unknowns, by default all of windows and media."""
    media = {"air": 1.0, "glass": 1.52, "water": 1.333}
    sigma = sigma or {}

    def chosen(label: str) -> bool:
        return free is None or label in free

    windows = tuple(
        replace(
            window,
            free=tuple(
                n for n in window_parameters(window.shape, pane=window.is_pane)
                if chosen(f"{n} of {window.name}")
            ),
            sigma={
                n: sigma[label] for n, label in zip(window.names, window.labels, strict=True)
                if label in sigma
            },
        )
        for window in WINDOWS[kind]
    )  # fmt: skip
    indices = tuple(
        RefractiveIndex(name, value, chosen(f"index of {name}"), sigma.get(f"index of {name}"))
        for name, value in media.items()
    )
    network = base.network
    path = tuple(range(len(windows)))
    refraction = Refraction(indices, windows, (path,), np.zeros(len(network.images), np.intp))
    rays = RefractedRays.of(
        refraction.columns(refraction.values), refraction.path_of, base.rotation, base.x0, base.xyz,
        network.image_of, network.point_of,
    )  # fmt: skip
    xy = network.xy.copy()
    for c, cam in enumerate(network.cameras):
        rows = network.camera_of[network.image_of] == c
        xy[rows] = mapping_of(cam)(rays.uv[rows])
    return replace(base, network=replace(network, xy=xy, refraction=refraction))


def normalised_errors(world: World, fit: Any) -> dict[str, float]:
    """Mean squares of errors over their covariances, of camera, poses and points; one if these cover.

    Errors of a free network are in the datum of its covariances, that of its inner constraints.
    """
    network, unknowns = world.network, fit.unknowns
    found: dict[str, float] = {}
    cam = network.cameras[0]
    at = unknowns.camera[0] + np.arange(len(cam.free))
    rows = [cam.names.index(name) for name in cam.free]
    off = fit.values.cameras[0, rows] - cam.values[rows]
    found["camera"] = float(off @ np.linalg.solve(fit.cofactors.reduced.full[np.ix_(at, at)], off)) / len(at)
    images = []
    for i, start in enumerate(unknowns.pose):
        turned = matrix_to_vector(fit.values.rotation[i] @ world.rotation[i].T)
        e = np.concatenate([turned, fit.values.x0[i] - world.x0[i]])
        q = fit.cofactors.reduced.full[start : start + 6, start : start + 6]
        images.append(float(e @ np.linalg.solve(q, e)) / 6)
    found["poses"] = float(np.mean(images))
    free = np.flatnonzero(~network.held.any(axis=1) & fit.usable.points)
    e = (fit.values.xyz - world.xyz)[free]
    squares = np.einsum("pi,pij,pj->p", e, np.linalg.inv(fit.cofactors.points[free]), e)
    found["points"] = float(squares.mean()) / 3
    return found


BATTERY = {
    "brown-object": camera("brown-object"),
    "brown-image": camera("brown-image"),
    "opencv-5": camera("opencv", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")),
    "opencv-8": camera("opencv-8", ("fx", "fy", "cx", "cy", "k1", "p1", "p2", "k4")),
    "ebner": with_ebner("camera"),
    "ebner-per-group": with_ebner("group"),
    "wong": wong(),
    "polynomial": polynomial(),
}
"""Every model of a camera that can be calibrated."""


def points_of(remark: str) -> set[tuple[str, str]]:
    """Images and points that a remark names, as `in image i1: points p1, p2; in image i2: point p3`."""
    found = set()
    for part in remark.split("in image ")[1:]:
        image, _, names = part.partition(": point")
        found |= {(image, name.strip()) for name in names.removeprefix("s").partition(";")[0].split(",")}
    return found
