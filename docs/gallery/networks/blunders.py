r"""
Which observation is wrong?
===========================

A gross error does not show where it was made: least squares spreads it over many residuals. Data snooping
looks at every residual in units of its own standard deviation, rejects the largest, and adjusts again.
"""

# %%
# A network of eight images with four gross errors of up to 2 px; the others have a noise of 0.05 px.
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau.bundle import Options, example_network

network = example_network(noise_px=0.05, seed=5)
wrong = np.array([12, 47, 101, 133])
xy = network.xy.copy()
xy[wrong] += [[2.0, -1.0], [0.0, 0.6], [-0.4, 0.3], [1.2, 1.2]]
network = replace(network, xy=xy)

kept = reseau.adjust_network(network).required()
found = reseau.adjust_network(network, Options(outliers="reject")).required()
print("kept:    ", kept)
print("rejected:", found)

# %%
# Every step of the search with the test value that decided it.
for step in found.steps:
    row, axis = divmod(step.index[0], 2)
    point, image = network.points[network.point_of[row]], network.images[network.image_of[row]]
    print(f"|w| = {step.statistic:5.1f}, critical {step.critical:.2f}: {'xy'[axis]} of {point} in {image}")
assert set(np.flatnonzero(found.rejected)) == set(wrong)
assert 0.8 < found.sigma0 < 1.2 < kept.sigma0

# %%
# Test values of all image points before and after. Before, good observations have large values too, because
# the wrong ones have bent the network.
figure, panels = plt.subplots(1, 2, figsize=(8.4, 3.6), layout="constrained", sharey=True)
for axes, result, title in zip(
    panels, (kept, found), ("with the gross errors", "after rejection"), strict=True
):
    w = np.abs(result.test_values).max(axis=1)
    good = np.setdiff1d(np.arange(len(w)), wrong)
    axes.semilogy(good, w[good], ".", color="#9aa3a8", label="good")
    shown = np.isfinite(w[wrong])
    axes.semilogy(wrong[shown], w[wrong][shown], "o", color="#b3402a", label="gross error")
    axes.axhline(3.29, color="#2f5d7c", linewidth=0.8)
    axes.set_title(title, loc="left")
    axes.set_xlabel("image point")
panels[0].set_ylabel("test value |w|")
panels[0].legend(frameon=False, loc="lower right")
