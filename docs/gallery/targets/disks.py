r"""
A sheet of disks in one photograph
==================================

A printed sheet of disks is the simplest target: print it, fix it to something flat, photograph it. Four
coded rings number the disks, so that the sheet is recognised in any orientation, also when a part of it is
hidden.

Here the photograph is formed by the program, so that the true place of every disk is known.
"""

# %%
# A camera looks at the sheet from the side. Light, blur and noise are those of an ordinary industrial
# camera.
import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau.designs import coded_sheet
from reseau.optics import OpenCV, Pose, Sensor, illumination, project
from reseau.optics.formation import Outline, draw, polygons

sheet = coded_sheet(12, 9, 20.0)
camera = OpenCV.from_parameters({"fx": 900.0, "fy": 900.0, "cx": 399.5, "cy": 299.5, "k1": -0.15})
turned = Pose.from_angles(0.45, -0.25, 0.3, np.zeros(3))
pose = Pose(turned.rotation, -turned.matrix.T @ [0.0, 5.0, 340.0])
middle = sheet.xy.mean(axis=0)


def view(xy):
    """Image of points of the sheet, and its derivatives."""
    seen = project(camera, pose, np.column_stack([xy - middle, np.zeros(len(xy))]))
    return seen.xy, seen.d_point[:, :, :2]


def sector(at, start, end):
    """A piece of a coded ring."""
    angles = np.deg2rad(np.linspace(start, end, 60))
    arc = np.column_stack([np.cos(angles), np.sin(angles)])
    return at + np.concatenate([arc * sheet.rings.outer / 2, arc[::-1] * sheet.rings.inner / 2])


disk = Outline.circle(sheet.mark.size / 2, 0.2)
disks = Outline(sheet.xy[:, None] + disk.xy, np.broadcast_to(disk.dxy, (len(sheet.ids), *disk.dxy.shape)))
places = dict(zip(sheet.ids, sheet.xy, strict=True))
rings = polygons(
    np.array([sector(places[name], *ends) for name, parts in sheet.rings.sectors.items() for ends in parts]),
    0.2,
)
shape = (600, 800)
ink = sum(draw(outline.mapped(view).oriented(), shape, 0.8) for outline in (disks, rings))
light = 190.0 * illumination(800, 600, gradient=(0.2, -0.15)) * (1 - 0.85 * ink)
light[430:, 480:620] = 70.0  # something in front of the sheet
frame = reseau.Frame(
    Sensor(800, 600, gain=40.0, read_noise=1.5).expose(light, np.random.default_rng(1)), 255.0
)

# %%
# One call measures it. The result names every disk that was declined, with the reason.
found = reseau.measure(frame, sheet).required()
print(found)
print({str(code) for code in found.codes if code})

axes = found.plot(frame=frame)
axes.figure.set_size_inches(7.2, 5.6)
axes.set_title(f"{found.found} of {len(sheet.ids)} disks; crosses are hidden ones", loc="left")

# %%
# The errors are as large as the standard deviations say: divided by them, their root mean square is near
# one.
error = found.xy - view(sheet.xy)[0]
sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
ratio = (error / sigma)[found.ok]
print(
    f"errors {np.sqrt(np.mean(error[found.ok] ** 2)):.4f} px, {np.sqrt(np.mean(ratio**2)):.2f} × their sigmas"
)
assert found.found > 80
assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.25

figure, axes = plt.subplots(figsize=(5.6, 3.2), layout="constrained")
axes.hist(ratio.ravel(), np.linspace(-4, 4, 33), density=True, color="#9aa3a8")
t = np.linspace(-4, 4, 200)
axes.plot(t, np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi), color="#b3402a")
axes.set_xlabel("error / standard deviation")
axes.set_title("errors of the image coordinates, and the normal distribution", loc="left")
