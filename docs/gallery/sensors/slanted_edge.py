r"""
Sharpness from a slanted edge
=============================

An edge that is slanted by a few degrees crosses the pixels at every distance from their centres: together
its rows sample the transition far more finely than the pixels do. Its slope gives the modulation transfer
function, the contrast that the camera leaves to details of every size.
"""

# %%
# A photograph of four dark squares, sharp in the middle of the image and less so outside.
import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau.optics import Sensor
from reseau.optics.formation import draw, polygons
from reseau.sensor import measure_edges

turn = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
square = 45.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]]) @ turn.T
blurs = {(110.0, 110.0): 0.5, (310.0, 110.0): 0.9, (110.0, 290.0): 1.3, (310.0, 290.0): 2.0}
light = np.full((400, 420), 190.0)
for centre, blur in blurs.items():
    light -= 150.0 * draw(polygons(square[None] + centre, 0.3), light.shape, blur)
frame = reseau.Frame(
    Sensor(420, 400, gain=30.0, read_noise=1.0).expose(light, np.random.default_rng(3)), 255.0
)

# %%
# Edges are found, and each is measured twice: with a Gaussian, and with a free curve that assumes no form.
edges = [edge for edge in measure_edges(frame) if edge.found]
print(len(edges), "edges")
figure, (picture, axes) = plt.subplots(1, 2, figsize=(9.2, 4.0), layout="constrained")
picture.imshow(frame.pixels, cmap="gray")
picture.set(xticks=[], yticks=[])
for edge in edges:
    picture.plot(*edge.at.xy.T, color="#e05a3a", linewidth=1.5)
    centre = min(blurs, key=lambda at: np.hypot(*(edge.at.centre - at)))
    psf, sigma = edge.found.fit["psf"], edge.found.fit.sigma_of("psf")
    print(f"{edge.at.name}: blur {psf:.3f} ± {sigma:.3f} px, true {blurs[centre]} px")
    assert abs(psf - blurs[centre]) < 6 * sigma + 0.01
f = np.linspace(0, 0.5, 60)
for blur, colour in zip(sorted(blurs.values()), ("#2f5d7c", "#6f9a3a", "#c08a2a", "#b3402a"), strict=True):
    edge = min(edges, key=lambda edge: abs(edge.found.fit["psf"] - blur))
    value, sigma = edge.found.free.mtf(f)
    axes.fill_between(f, value - 2 * sigma, value + 2 * sigma, color=colour, alpha=0.3, linewidth=0)
    axes.plot(f, edge.found.mtf(f), color=colour, label=f"blur {blur} px")
axes.axhline(0.5, color="#9aa3a8", linewidth=0.6)
axes.set(xlabel="cycles per pixel", ylabel="modulation transfer", ylim=(0, 1.05))
axes.legend(frameon=False)
