r"""
An uncertainty budget, checked by Monte Carlo
=============================================

The distance of two points from a pair of photographs: what contributes to its uncertainty, and is the law
of propagation good enough? The guide to the expression of uncertainty (GUM) answers the first question with
a budget, its supplement 1 the second by drawing.
"""

# %%
# Depth from parallax, Z = B c / p. Base and principal distance come from a certificate, the parallax from
# 12 repeated measurements, and the temperature moves the base by what is only known to lie within limits.
import matplotlib.pyplot as plt
import numpy as np

from reseau.adjust import Contribution, propagate, simulate

names = ("base", "principal distance", "parallax")
x = np.array([250.0, 16.0, 0.8])  # mm


def depth(x):
    """Depth (n, 1) of inputs (n, 3), mm."""
    return x[:, :1] * x[:, 1:2] / x[:, 2:]


contributions = (
    Contribution("certificate of the base", np.diag([0.05**2, 0, 0])),
    Contribution("temperature of the base", np.diag([0.08**2 / 3, 0, 0]), distribution="rectangular"),
    Contribution("calibration of the camera", np.diag([0, 0.004**2, 0])),
    Contribution("12 readings of the parallax", np.diag([0, 0, 0.02**2]), degrees=11),
)
budget = propagate(depth, x, contributions, names=("Z",), inputs=names, units=("mm",))
print(budget)
for each, sigma in zip(contributions, budget.by_contribution[:, 0], strict=True):
    print(f"  {each.name:30s} {sigma:8.3f} mm")

# %%
# The same by 200 000 draws. The parallax stands in the denominator and has the largest share: the
# distribution of the depth is skewed, and the interval is not symmetric about the estimate.
drawn = simulate(depth, x, contributions, draws=200_000, seed=1)
low, high = budget.values[0] + np.array([-1, 1]) * budget.expanded()[0]
print(f"propagated: {low:.0f} to {high:.0f} mm")
print(f"drawn:      {drawn.low[0]:.0f} to {drawn.high[0]:.0f} mm (95 %)")

rng = np.random.default_rng(1)
inputs = x + np.column_stack([
    0.05 * rng.normal(size=200_000) + 0.08 * rng.uniform(-1, 1, 200_000),
    0.004 * rng.normal(size=200_000),
    0.02 * rng.standard_t(11, 200_000),
])  # fmt: skip
figure, axes = plt.subplots(figsize=(7.2, 3.8), layout="constrained")
axes.hist(depth(inputs)[:, 0], np.linspace(4400, 5900, 120), density=True, color="#9aa3a8")
z = np.linspace(4400, 5900, 400)
sigma = budget.sigma[0]
axes.plot(z, np.exp(-((z - 5000.0) ** 2) / (2 * sigma**2)) / (sigma * np.sqrt(2 * np.pi)), color="#2f5d7c")
for end in (drawn.low[0], drawn.high[0]):
    axes.axvline(end, color="#b3402a")
for end in (low, high):
    axes.axvline(end, color="#2f5d7c", linestyle="--")
axes.set(xlabel="depth / mm", yticks=[])
axes.set_title("depth: drawn (grey, red) and propagated (blue)", loc="left")

# %%
# The guide asks whether both agree to the digits that are stated. Here they do not: the upper end differs
# by more than half of a unit in the second digit of the standard uncertainty.
print(f"upper ends differ by {drawn.high[0] - high:.0f} mm, standard uncertainty {sigma:.0f} mm")
assert abs(budget.values[0] - 5000) < 1e-9
assert drawn.high[0] - high > 5.0
assert abs(drawn.sigma[0] / sigma - 1) < 0.2
