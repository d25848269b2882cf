r"""
A picture of every result
=========================

Results draw themselves: ``.plot()`` of a measurement, a calibration, an adjustment. Without axes they make
a figure, with axes they draw into one of your own. In a notebook, their last line is a table.
"""

# %%
# Six photographs of a coded testfield, simulated; a calibration with one call.
import matplotlib.pyplot as plt

import reseau
from reseau.calibration import projection_field
from reseau.optics import Brown, PixelGrid, Sensor
from reseau_sims import FieldBench, Station

camera = Brown(side="object", grid=PixelGrid(640, 480, (0.006, 0.006))).with_values({"c": 3.8, "K1": -1.5e-3})
bench = FieldBench(
    seed=3, camera=camera, sensor=Sensor(640, 480, read_noise=1.2), bend_mm=0.0, distance_mm=1350.0
)
stations = [
    Station(0.0),
    Station(30.0, 0.0),
    Station(30.0, 90.0, 90.0),
    Station(30.0, 180.0),
    Station(40.0, 270.0, 90.0),
]
frames = [bench.record(station) for station in stations]
calibrated = reseau.calibrate(frames, bench.design, pitch_mm=0.006).required()
print(calibrated)

# %%
# A measured photograph, the residuals of all, the error of the projection and its formal part.
calibrated.plot(frames[1])

# %%
# The same pieces in a figure of your own.
figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.9), layout="constrained")
reseau.measure(frames[2], bench.design).required().plot(left, frames[2])
projection_field(calibrated.calibration("camera").mapping()).plot(right)

# %%
# And the numbers: every estimate with its standard deviation and correlation.
(estimate,) = calibrated.cameras.values()
print(estimate)
columns = estimate.parameters, estimate.values, estimate.sigma, estimate.units
for name, value, sigma, unit in zip(*columns, strict=True):
    print(f"{name:3s} {value:12.6g} ± {sigma:8.2g} {unit}")
assert abs(estimate.values[0] - 3.8) < 5 * estimate.sigma[0]
