r"""
How precisely can a mark be measured?
=====================================

The Cramér–Rao bound is the smallest standard deviation that any unbiased method can reach: it follows from
the gradients of the image and its noise alone. This example measures the same small disk many times, in
more and more noise and in uneven light, and compares matching with the centre of gravity.
"""

# %%
# A dark disk with a diameter of 8 px, formed exactly, at random places between the pixels. The light
# falls off by a twentieth over the disk.
import matplotlib.pyplot as plt
import numpy as np

from reseau.measure import MatchOptions, match
from reseau.optics.formation import Outline, PixelResponse, coverage

disk, response, blur = Outline.circle(4.0, 0.4), PixelResponse(), np.ones(1)
x, y = np.arange(23.0)[None], np.arange(23.0)[None]
options = MatchOptions(half_px=9, psf_px=1.0)
rng = np.random.default_rng(0)


def formed(at):
    """Grey values with the disk at a place, without noise."""
    placed = Outline(disk.xy[None] + at, disk.dxy[None])
    return (200.0 + 1.2 * (x[0] - 11.0)) * (1 - 0.6 * coverage(placed, x, y, blur, response)[0])


def gravity_of(grey):
    """Centre of gravity of what is darker than half the contrast."""
    weight = np.clip(140.0 - grey, 0.0, None)
    return np.array([weight.sum(axis=0) @ x[0], weight.sum(axis=1) @ y[0]]) / weight.sum()


step = 1e-3 * np.eye(2)
slope = np.stack([(formed(11.0 + e) - formed(11.0 - e)) / 2e-3 for e in step])
bound_of_one = 1 / np.sqrt((slope**2).sum(axis=(1, 2)).mean())

# %%
# Both methods see the same 60 images at every level of noise.
levels, rows = np.array([0.5, 1.0, 2.0, 4.0, 8.0]), []
outline, good = Outline(disk.xy[None], disk.dxy[None]), np.ones((23, 23), dtype=bool)
for noise in levels:
    errors = []
    for _ in range(60):
        at = 11.0 + rng.uniform(-0.5, 0.5, 2)
        grey = formed(at) + rng.normal(0.0, noise, (23, 23))
        found = match(grey, good, outline, np.array([[11.0, 11.0]]), options, noise=noise)
        errors.append([found.xy[0] - at, gravity_of(grey) - at, np.sqrt(np.diag(found.cov[0]))])
    rows.append((noise * bound_of_one, *np.sqrt(np.mean(np.square(errors), axis=(0, 2)))))
bound, matched, gravity, stated = np.array(rows).T

figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
axes.loglog(levels, gravity, "s-", color="#9aa3a8", label="centre of gravity")
axes.loglog(levels, matched, "o", color="#2f5d7c", label="matching")
axes.loglog(levels, bound, color="#b3402a", label="Cramér–Rao bound")
axes.set(xlabel="noise / grey values", ylabel="rms error / px")
axes.legend(frameon=False)

# %%
# Matching estimates width of the blur, contrast and background with the position, and still reaches the
# bound to within the scatter of 120 errors at each level. The standard deviations it states agree with
# its errors.
print("matching / bound: ", (matched / bound).round(2))
print("stated / error:   ", (stated / matched).round(2))
print("gravity / bound:  ", (gravity / bound).round(1))
assert np.all((matched / bound > 0.8) & (matched / bound < 1.25))
assert np.all((stated / matched > 0.8) & (stated / matched < 1.25))
assert np.all(gravity > matched)
