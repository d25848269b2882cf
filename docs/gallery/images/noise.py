r"""
From light to grey values
=========================

What a camera records of a mark is decided by four things: the optics spread it, the pixels integrate it,
the electrons scatter, and the converter rounds. This example takes the same cross through all four.
"""

# %%
# A dark cross of 14 px with arms of 2.5 px, exact to a thousandth of a pixel, seen by four cameras.
import matplotlib.pyplot as plt
import numpy as np

from reseau.optics import Sensor, snr_db
from reseau.optics.formation import Outline, PixelResponse, coverage, mark_outline

cross = mark_outline("cross", 14.0, 2.5, 0.2)
at = np.array([16.3, 15.8])
pixels = np.arange(33.0)[None]


def light(blur, fill=1.0):
    """Grey values of the cross without noise."""
    placed = Outline(cross.xy[None] + at, cross.dxy[None])
    return 180.0 * (1 - 0.8 * coverage(placed, pixels, pixels, np.array([blur]), PixelResponse(fill))[0])


cameras = {
    "sharp, 40 electrons per grey value": (0.4, Sensor(33, 33, gain=40.0, read_noise=1.0)),
    "blurred by 2 px": (2.0, Sensor(33, 33, gain=40.0, read_noise=1.0)),
    "1.5 electrons per grey value": (0.4, Sensor(33, 33, gain=1.5, read_noise=1.0)),
    "4 bits": (0.4, Sensor(33, 33, bits=4, gain=40.0)),
}
rng = np.random.default_rng(0)
figure, panels = plt.subplots(2, 4, figsize=(9.0, 4.4), layout="constrained", height_ratios=(1, 0.75))
for (above, below), (name, (blur, sensor)) in zip(panels.T, cameras.items(), strict=True):
    scale = sensor.full_scale / 255.0
    grey = sensor.expose(light(blur) * scale, rng) / scale
    above.imshow(grey, cmap="gray", vmin=0, vmax=200)
    above.set(xticks=[], yticks=[])
    above.set_title(name, loc="left", fontsize=9)
    below.plot(light(blur)[16], color="#9aa3a8")
    below.plot(grey[16], drawstyle="steps-mid", color="#b3402a", linewidth=0.9)
    below.set(ylim=(0, 220), xticks=[], yticks=[0, 100, 200])

# %%
# The variance of the grey values is that of the electrons, of reading and of rounding: 1/12 of a grey value
# squared, as long as the noise is larger than the steps.
sensor = cameras["1.5 electrons per grey value"][1]
frames = np.stack([sensor.expose(light(0.4), rng) for _ in range(400)]).astype(float)
measured, predicted = frames.var(axis=0, ddof=1), sensor.variance(light(0.4))
print(f"variance, measured over predicted: {np.mean(measured / predicted):.3f}")
print(f"signal to noise: {snr_db(float(np.sqrt(predicted.mean()))):.1f} dB")
assert abs(np.mean(measured / predicted) - 1) < 0.02
