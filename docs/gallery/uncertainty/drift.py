r"""
Has the camera drifted?
=======================

A bench calibrates its camera every week. Each calibration differs from the last one; a control chart says
when the differences are more than that. It learns the scatter from the runs themselves, and its limits hold
a rate of false alarms: here one in ten years, over all parameters together.
"""

# %%
# Two years of weekly calibrations of three parameters. After run 60 the principal distance begins to
# creep, by a fifth of its standard deviation each month.
import matplotlib.pyplot as plt
import numpy as np

from reseau.service import ChartOptions, monitor

rng = np.random.default_rng(7)
names, sigma = ("c", "x0", "y0"), np.array([0.0012, 0.0020, 0.0018])
values = np.array([8.031, 0.042, -0.017]) + sigma * rng.normal(size=(104, 3))
values[60:, 0] += 0.05 * sigma[0] * np.arange(44)

charts = monitor(values, ChartOptions(rate=0.1, runs_per_year=52))
run, series = charts.first_alarm()
since = charts.since(run, series)
print(f"alarm in run {run}: {names[series]} has changed since about run {since}")
assert names[series] == "c"
assert 60 < run < 100
assert not charts.alarm[:60].any()

# %%
# The values with their predictions, and the sums of the chart with their limit.
figure, (above, below) = plt.subplots(2, 1, figsize=(7.6, 5.0), layout="constrained", sharex=True)
runs = np.arange(104)
above.plot(runs, values[:, 0], ".", color="#2f5d7c")
above.fill_between(
    runs,
    *(charts.expected[:, 0] + k * charts.sigma[:, 0] for k in (-2, 2)),
    color="#9aa3a8",
    alpha=0.35,
    linewidth=0,
)
above.axvline(run, color="#b3402a")
above.axvline(since, color="#b3402a", linestyle=":")
above.set_ylabel("c / mm")
above.set_title("principal distance, and twice the standard deviation of its prediction", loc="left")
for k, (name, colour) in enumerate(zip(names, ("#2f5d7c", "#9aa3a8", "#6f9a3a"), strict=True)):
    below.plot(runs, charts.upper[:, k], color=colour, label=name)
    below.plot(runs, -charts.lower[:, k], color=colour)
for side in (-1, 1):
    below.axhline(side * charts.limits.limit, color="#b3402a", linewidth=0.8)
below.set(xlabel="run", ylabel="cumulative sum")
below.legend(frameon=False, loc="upper left", ncols=3)

# %%
# What such a chart can do: the mean number of runs until a shift of this size is noticed.
for shift in (0.0, 0.5, 1.0, 2.0, 4.0):
    print(f"shift {shift:3.1f} sigma: noticed after {charts.limits.arl(shift):9.1f} runs")
