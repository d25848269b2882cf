r"""
How many distortion parameters?
===============================

More parameters always fit better. Whether they describe the camera, or only this day's noise, is another
question: it is answered by the description length, which weighs the residuals against the number of
parameters, and by predicting images that were left out.
"""

# %%
# A network whose camera really has radial distortion of two terms, and nothing else.
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from reseau.bundle import Candidate, adjust_network, choose_model, example_network
from reseau.optics import Pose, project

network = example_network(seed=2)
camera = network.cameras[0]
values = np.array([8.0, 0.02, -0.01, 2e-3, -8e-5, *np.zeros(5)])
found = adjust_network(network).required()
rng, xy = np.random.default_rng(5), []
for x0, rotation in zip(found.images.x0, found.images.rotation, strict=True):
    xy.append(project(camera.bare_mapping(values), Pose(rotation, x0), network.xyz).xy)
network = replace(network, xy=np.concatenate(xy) + rng.normal(0, 0.05, network.xy.shape))

# %%
# From no distortion to seven parameters. Each candidate is adjusted; those that come close are
# cross-validated.
interior = ("c", "x0", "y0")
steps = ("", "K1", "K1 K2", "K1 K2 K3", "K1 K2 P1 P2", "K1 K2 K3 P1 P2 B1 B2")
choice = choose_model(network, [Candidate("brown", (*interior, *more.split())) for more in steps]).required()
print(choice)
for each in choice.compared:
    print(f"{each.candidate.label:32s} length {each.length:7.1f}   {each.reason}")
assert choice.chosen.candidate.label == "brown: K1 K2"

# %%
# The residuals fall with every parameter, the description length turns.
order = {f"brown: {more or 'no distortion'}": k for k, more in enumerate(steps)}
table = sorted(choice.compared, key=lambda each: order[each.candidate.label])
labels = [each.candidate.label.removeprefix("brown: ") for each in table]
figure, (above, below) = plt.subplots(2, 1, figsize=(7.0, 4.6), layout="constrained", sharex=True)
above.semilogy(labels, [each.cost for each in table], "o-", color="#9aa3a8")
above.set_ylabel(r"$v^T P v$")
below.plot(labels, [each.length for each in table], "o-", color="#2f5d7c")
below.plot("K1 K2", choice.chosen.length, "o", color="#b3402a", markersize=9)
below.set(yscale="symlog", ylabel="description length\nless the best")
below.tick_params(axis="x", rotation=20)
