r"""
A film frame, oriented by its edges
===================================

Photographs on film without fiducial marks still have one thing that the camera made: the edges of the
frame, which are the shadow of its gate. Four straight lines give four corners, and these the place,
rotation and scale of the frame in the scan, to a fraction of a pixel.
"""

# %%
# A frame of 36 × 24 mm on a desktop scanner at 600 dpi, turned by 0.6°, with dust and scratches.
import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau_sims.filmframe import Beside, FilmFrame

film = FilmFrame(seed=5, beside=Beside(perforations=True, dust=20, scratches=4))
scan, truth = film.scan(), film.truth
(found,) = reseau.orient(scan, dpi=600.0, format_mm=(36.0, 24.0))
print(found)

# %%
# The corners are intersections of the fitted edges; no corner needs to be visible itself.
corners = found.document().corners
xy = np.array([[corners[name].x, corners[name].y] for name in ("ul", "ur", "lr", "ll")])
sigma = np.array([[corners[name].sx, corners[name].sy] for name in ("ul", "ur", "lr", "ll")])
error = xy - truth.corners
print(f"corners: errors up to {np.abs(error).max():.3f} px, sigmas {sigma.min():.3f} to {sigma.max():.3f} px")
assert np.abs(error).max() < 0.5

figure, (whole, near) = plt.subplots(1, 2, figsize=(8.4, 3.6), layout="constrained", width_ratios=(1.5, 1))
for axes in (whole, near):
    axes.imshow(scan, cmap="gray")
    axes.plot(*np.vstack([xy, xy[:1]]).T, color="#e05a3a", linewidth=1.0)
    axes.set(xticks=[], yticks=[])
whole.set_title("the scan, and the frame that was found", loc="left")
x, y = xy[0]
near.set(xlim=(x - 12, x + 22), ylim=(y + 22, y - 12))
near.plot(*truth.corners[0], "+", color="#4c9bc9", markersize=14)
near.set_title("upper left corner; + is the truth", loc="left")
