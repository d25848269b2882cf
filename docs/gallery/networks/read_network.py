r"""
A network of another program, adjusted again
============================================

Structure from motion programs write what they found: cameras, places, points. Read as a network, it can be
adjusted again with everything that matters for measuring: standard deviations, tests, warnings.
"""

# %%
# A text model of COLMAP. Here it is written by the program itself, from a small simulated network; any
# folder with ``cameras.txt``, ``images.txt`` and ``points3D.txt`` will do, and so do the files of a dozen
# others.
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau.bundle import example_network
from reseau.exchange import read_network
from reseau.exchange.networks import write_network
from reseau.optics import rotation_matrix

first = reseau.adjust_network(example_network()).required()
with tempfile.TemporaryDirectory() as folder:
    model = Path(folder, "sparse")
    write_network(first, model)
    print(sorted(path.name for path in model.iterdir()))
    network = read_network(model)
print(network)

# %%
# The adjustment takes the approximate values from the file.
found = reseau.adjust_network(network).required()
print(found)
for warning in found.warnings:
    print("-", warning)

# %%
# The network in space: cameras with their axes, and points.
figure = plt.figure(figsize=(7.2, 5.4), layout="constrained")
axes = figure.add_subplot(projection="3d")
points, images = found.points, found.images
axes.scatter(*points.xyz.T, s=10, color="#2f5d7c", depthshade=False)
size = 0.25 * np.ptp(images.x0, axis=0).max()
for x0, rotation in zip(images.x0, images.rotation, strict=True):
    view = x0 + size * rotation_matrix(rotation)[2]  # along the optical axis
    axes.plot(*np.stack([x0, view]).T, color="#b3402a", linewidth=1.2)
axes.scatter(*images.x0.T, s=22, color="#b3402a", depthshade=False)
axes.set_box_aspect(np.ptp(np.concatenate([images.x0, points.xyz]), axis=0), zoom=0.95)
for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
    axis.set_pane_color((0.0, 0.0, 0.0, 0.0))
axes.view_init(22, -60)

# %%
# COLMAP's camera model has other parameters, in pixels; the residuals are the same, and the principal
# distance is that before.
(camera,) = found.cameras.values()
print(camera)
sigma = camera.sigma[camera.parameters.index("c")]
focal_px = first.cameras["camera"]["c"] / 0.01
print(f"focal length {camera['c']:.2f} ± {sigma:.2f} px, before {focal_px:.2f} px")
assert abs(camera["c"] - focal_px) < 3 * sigma
print(f"standard deviation of the image coordinates {found.sigma0:.3f} px (the files state none: 1 px)")
assert 0.04 < found.sigma0 < 0.06
