r"""
Through a port into water
=========================

Behind a flat port the rays of a camera are bent twice, in glass and in water. They no longer meet in one
point, so that the effect depends on the distance of the object: no distortion model of a camera in air can
describe it exactly.
"""

# %%
# A camera of 8 mm behind a flat port of 12 mm, 60 mm in front of the projection centre.
import matplotlib.pyplot as plt
import numpy as np

from reseau_sims import Water

port, focal_px = Water(distance_mm=60.0, thickness_mm=12.0), 8.0 / 0.005

# %%
# The direction in which the camera sees points at four distances, against the direction that they would
# have in air. First everything: water makes objects look a third larger.
radius = np.linspace(0.02, 0.5, 25)  # tangent of the true direction
figure, whole = plt.subplots(figsize=(6.4, 3.7), layout="constrained")
seen, reference = {}, np.linspace(0.001, 0.9, 400)
straight = 1000.0 * np.column_stack([reference, np.zeros(400), np.ones(400)])
at_1_m = port.directions(straight).xy[:, 0]
for distance, shade in zip((200.0, 400.0, 1000.0, 4000.0), (0.15, 0.4, 0.65, 0.9), strict=True):
    points = np.column_stack([radius, np.zeros_like(radius), np.ones_like(radius)]) * distance
    seen[distance] = port.directions(points).xy[:, 0]
    colour = plt.get_cmap("viridis")(shade)
    whole.plot(radius, seen[distance] / radius, color=colour, label=f"{distance / 1000:g} m")
whole.set(xlabel="tangent of the true direction", ylabel="seen / true direction")
whole.legend(frameon=False, title="distance")

# %%
# Then what is left when a camera is calibrated at 1 m and used at another distance: a scale, and a
# distortion of a few pixels that changes with the distance.
figure, rest = plt.subplots(figsize=(6.4, 3.7), layout="constrained")
for distance, shade in zip((200.0, 400.0, 4000.0), (0.15, 0.4, 0.9), strict=True):
    # Where the calibration at 1 m believes the point to be, for the same image.
    believed = np.interp(seen[distance], at_1_m, reference)
    scale = (believed @ radius) / (radius @ radius)
    error = focal_px * (believed - scale * radius)
    rest.plot(radius, error, color=plt.get_cmap("viridis")(shade), label=f"{distance / 1000:g} m")
    print(f"{distance / 1000:g} m: scale {scale:.4f}, then up to {np.abs(error).max():.2f} px")
rest.axhline(0.0, color="#9aa3a8", linewidth=0.6)
rest.set(xlabel="tangent of the true direction", ylabel="error / px")
rest.set_title("calibrated at 1 m, after the best scale", loc="left")
rest.legend(frameon=False, title="distance")

# %%
# For comparison: looked at steeply, the magnification in deep water is the refractive index.
steep = port.directions(np.array([[50.0, 0.0, 1e6]])).xy[0, 0] / 5e-5
print(f"index of the water {port.index:.4f}, seen/true close to the axis and far away {steep:.4f}")
assert abs(steep - port.index) < 2e-3
