r"""
The photon transfer curve
=========================

How many electrons is one grey value? The noise tells: it grows with the light, because electrons arrive one
by one, and its slope is the gain. Nothing is needed but even light and pairs of frames.
"""

# %%
# A sensor of 12 bits with 3.2 electrons per grey value, and a read noise of 1.8 grey values; six levels of
# light and one dark level, eight frames each.
import matplotlib.pyplot as plt
import numpy as np

from reseau.optics import Sensor
from reseau.sensor import Level, SensorSeries, calibrate_sensor

sensor = Sensor(160, 120, bits=12, gain=3.2, read_noise=1.8, offset=60.0)
rng = np.random.default_rng(4)
response = 1 + 0.01 * rng.normal(size=(120, 160))  # pixels differ by 1 %


def level(exposure_us, signal):
    """Frames at one exposure."""
    return Level.of(exposure_us, [sensor.expose(signal * response, rng) for _ in range(8)])


dark = (level(100.0, 0.0), level(8000.0, 0.0))
bright = tuple(level(t, 0.35 * t) for t in (250.0, 500.0, 1000.0, 2000.0, 4000.0, 6000.0, 9000.0, 14000.0))
found = calibrate_sensor(SensorSeries(dark, bright, sensor.full_scale))

# %%
# Gain and read noise with their standard deviations, and the other numbers of the data sheet.
for name, quantity in found.quantities().items():
    print(f"{name:11s} {quantity.value:10.4g} ± {quantity.sigma:.2g} {quantity.unit}")
print(f"pixels differ by {100 * found.prnu:.2f} %")
quantities = found.quantities()
assert abs(quantities["gain"].value - 3.2) < 5 * quantities["gain"].sigma
assert abs(quantities["read_noise"].value - 1.8) < 5 * quantities["read_noise"].sigma
assert abs(found.prnu - 0.01) < 0.001

# %%
# The curve. The last level is saturated: its variance has collapsed, and it is not used.
curve = found.transfer.curve
lit = curve.bright
figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
axes.loglog(
    curve.signal[lit & curve.usable], curve.variance[lit & curve.usable], "o", color="#2f5d7c", label="used"
)
axes.loglog(
    curve.signal[lit & ~curve.usable],
    curve.variance[lit & ~curve.usable],
    "o",
    color="#9aa3a8",
    label="too bright",
)
s = np.geomspace(20, 4000, 100)
gain, read = quantities["gain"].value, quantities["read_noise"].value
axes.loglog(s, s / gain + read**2 + 1 / 12, color="#b3402a", label="electrons, reading, rounding")
axes.loglog(
    s, np.full_like(s, read**2 + 1 / 12), color="#9aa3a8", linewidth=0.8, label="reading and rounding"
)
axes.set(xlabel="signal / grey values", ylabel="variance / grey values²")
axes.legend(frameon=False)
