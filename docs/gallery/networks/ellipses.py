r"""
Where another photograph helps
==============================

Two photographs from nearly the same direction determine a point well across the view and badly along it.
The standard ellipses show this before anyone has to think about it, and one convergent photograph removes
it.
"""

# %%
# A wall of points, photographed by a camera that is already calibrated: first from two neighbouring
# places, then with a third from the side.
import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau.bundle import Camera, Network
from reseau.core.figures import draw_ellipses
from reseau.optics import Pose, matrix_to_vector, project

camera = Camera("camera", 2000, 1500, (0.005, 0.005), "brown", np.array([8.0, *np.zeros(9)]))
x, y = (a.ravel() for a in np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-1, 1, 3)))
xyz = np.column_stack([x, y, 0.3 * np.sin(2 * x)])
places = np.array([[-0.5, 0.0, 6.0], [0.5, 0.0, 6.0], [4.5, 0.0, 4.0]])


def pose_at(place):
    """Camera at a place that looks at the middle of the wall, the y axis of the image downwards."""
    z = -place / np.linalg.norm(place)
    x = np.cross([0.0, -1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return Pose(matrix_to_vector(np.stack([x, np.cross(z, x), z])), place)


def adjusted(count):
    """The network of the first `count` photographs; the four corners of the wall are control points."""
    rng, n = np.random.default_rng(1), len(xyz)
    poses = [pose_at(place) for place in places[:count]]
    seen = np.concatenate([project(camera.plane_mapping(), pose, xyz).xy for pose in poses])
    sigma = np.full((n, 3), np.nan)
    corners = np.flatnonzero((abs(x) == 2) & (abs(y) == 1))
    sigma[corners] = 0.0
    return reseau.adjust_network(
        Network(
            cameras=(camera,), images=tuple(f"photo {k + 1}" for k in range(count)),
            camera_of=np.zeros(count, dtype=np.intp), x0=np.array([p.x0 for p in poses]),
            rotation=np.array([p.rotation for p in poses]), points=tuple(map(str, range(n))), xyz=xyz,
            sigma=sigma, role=tuple("control" if k in corners else "tie" for k in range(n)),
            image_of=np.repeat(np.arange(count), n), point_of=np.tile(np.arange(n), count),
            xy=seen + rng.normal(0, 0.2, seen.shape), cov=np.tile(0.04 * np.eye(2), (count * n, 1, 1)),
            distance_of=np.zeros((0, 2), dtype=np.intp), distance=np.zeros((0, 2)), datum="control",
            datum_points=np.ones(n, dtype=bool), groups=(None,) * count, files=(None,) * count, unit="m",
        )
    ).required()  # fmt: skip


# %%
# Seen from above: the wall at the bottom, the cameras above it.
figure, panels = plt.subplots(1, 2, figsize=(9.0, 5.0), layout="constrained", sharey=True)
depth = []
for axes, count in zip(panels, (2, 3), strict=True):
    found = adjusted(count)
    row = np.flatnonzero(abs(y) < 1e-9)
    at, cov = found.points.xyz[row][:, [0, 2]], found.points.cov[row][:, [0, 2]][:, :, [0, 2]]
    axes.set(xlim=(-3, 5.2), ylim=(-1.2, 6.6), aspect="equal", xlabel="X / m")
    axes.plot(*found.images.x0[:, [0, 2]].T, "^", color="#2f5d7c", markersize=8)
    for place in found.images.x0:
        axes.plot([place[0], 0], [place[2], 0], color="#9aa3a8", linewidth=0.6)
    draw_ellipses(axes, at, cov, enlarged=200.0)
    depth.append(1000 * np.median(found.points.sigma[row, 2]))
    axes.set_title(f"{count} photographs: depth ± {depth[-1]:.2f} mm (ellipses × 200)", loc="left")
panels[0].set_ylabel("Z / m")
print(f"median sigma of the depth: {depth[0]:.2f} mm, with the third photograph {depth[1]:.2f} mm")
assert depth[1] < 0.5 * depth[0]
