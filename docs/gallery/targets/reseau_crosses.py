r"""
A reseau shows what a camera does to an image
=============================================

A reseau is a plate with marks at known places. Photographed with the object, it shows how camera and film
displace and stretch the image at every place. This is the idea of the whole project, and of its name.
"""

# %%
# PHOTO I of the oscilloscope procedure: a reseau before the evenly lit screen, on Polaroid film that was
# scanned. The simulated bench knows the truth.
import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau.core.figures import Panel, draw_vectors
from reseau_sims import World

world = World.standard(seed=3)
frame = world.photo_i()
found = reseau.measure(frame, world.design).required()
print(found)

axes = found.plot(frame=frame)
axes.figure.set_size_inches(7.4, 5.6)

# %%
# What is left after the best similarity (shift, rotation, scale) is the distortion of camera and film.
design = dict(zip(world.design.ids, world.design.xy, strict=True))
points = found.points
plane = np.array([design[name] for name in points.names])
z, w = plane @ [1, 1j], points.xy @ [1, -1j]  # y is up in the design, down in the image
similar = np.linalg.lstsq(np.column_stack([z, np.ones(len(z))]), w, rcond=None)[0]
rest = (w - (similar[0] * z + similar[1])) / similar[0]
distortion, scale = np.column_stack([rest.real, rest.imag]), abs(similar[0])

figure, axes = plt.subplots(figsize=(6.4, 5.2), layout="constrained")
none = (np.zeros((0, 2)), np.zeros((0, 2)))
draw_vectors(axes, (plane, distortion), none, Panel("mm"), "distortion by camera and film")

# %%
# The vectors are hundreds of times longer than the standard deviations: every detail of them is real.
rms_px = scale * np.sqrt(np.mean(distortion**2))
print(f"distortion {rms_px:.2f} px rms, median sigma {np.median(points.sigma):.4f} px")
assert rms_px > 100 * np.median(points.sigma)
assert found.found == len(world.design.ids)
