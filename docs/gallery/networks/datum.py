r"""
Free or fixed: what the datum does to standard deviations
=========================================================

Images alone determine the form of an object, not where it is. Something must define position, rotation and
scale: the datum. The form, and the residuals, do not depend on it, but the standard deviations of
coordinates do: they are relative to what was held.
"""

# %%
# The same network twice: with inner constraints over all points, and with three points held.
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau.bundle import example_network
from reseau.core.figures import draw_ellipses

network = example_network()
free = reseau.adjust_network(network).required()

held = np.full(network.xyz.shape, np.nan)
held[[0, 4, 15]] = 0.0  # seven of these nine coordinates would be enough
role = tuple("control" if k in (0, 4, 15) else "tie" for k in range(20))
fixed_network = replace(network, datum="control", sigma=held, role=role, xyz=free.points.xyz)
fixed = reseau.adjust_network(fixed_network).required()
print("free: ", free)
print("fixed:", fixed)

# %%
# Standard ellipses in the xy-plane, enlarged alike. Beside the held points those of the fixed network
# vanish, and grow with the distance from them.
figure, panels = plt.subplots(1, 2, figsize=(8.6, 3.9), layout="constrained", sharey=True)
for axes, result, title in zip(
    panels, (free, fixed), ("inner constraints", "three points held"), strict=True
):
    at = result.points.xyz[:, :2]
    axes.set(xlim=(-1.3, 1.3), ylim=(-1.05, 1.05), aspect="equal", xlabel="X / m")
    axes.plot(*at.T, ".", color="#9aa3a8")
    draw_ellipses(axes, at, result.points.cov[:, :2, :2], enlarged=300.0)
    sigma = 1e6 * np.sqrt(np.mean(result.points.sigma**2))
    axes.set_title(f"{title}: {sigma:.0f} µm (ellipses × 300)", loc="left")
panels[1].plot(*fixed.points.xyz[[0, 4, 15], :2].T, "s", color="#2f5d7c", markersize=6)
panels[0].set_ylabel("Y / m")

# %%
# Inner constraints give the smallest mean variance of all datums. What can be measured in the images,
# such as the ratio of two distances, does not depend on the datum.
mean = [np.mean(result.points.sigma**2) for result in (free, fixed)]


def ratio(result):
    """Distance of points 1 and 18 over that of 3 and 16."""
    xyz = result.points.xyz
    return np.linalg.norm(xyz[1] - xyz[18]) / np.linalg.norm(xyz[3] - xyz[16])


print(f"mean variance, fixed over free: {mean[1] / mean[0]:.2f}")
print(f"ratio of distances: {ratio(free):.6f} and {ratio(fixed):.6f}")
assert mean[0] < mean[1]
assert abs(ratio(free) - ratio(fixed)) < 1e-4
