r"""
Corners of a chessboard, sharp and blurred
==========================================

Many calibrations begin with a chessboard. How well its corners can be measured depends on the sharpness of
the image, and on the angle under which the board is seen. This example photographs one board three times
with more and more blur, and compares the errors with the standard deviations that the measurement states
itself.
"""

# %%
# Dark squares of the board, as the outlines of polygons in its plane.
import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau.designs import board
from reseau.optics import OpenCV, Pose, Sensor, project
from reseau.optics.formation import draw, polygons

chess = board("chess", 10, 7, 25.0)
dark = [(c, r) for r in range(7) for c in range(10) if (c + r) % 2 == 0]
unit = 25.0 * np.array(
    [[-1, 0], [-1, 1], [0, 1], [0, 0]]
)  # the first corner is at the lower right of a square
squares = polygons(np.array([unit[::-1] + 25.0 * np.array([c, -r]) for c, r in dark]), 0.2)

camera = OpenCV.from_parameters({"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5})
turned = Pose.from_angles(0.4, -0.35, 0.15, np.zeros(3))
pose = Pose(turned.rotation, -turned.matrix.T @ [0.0, 0.0, 420.0])


def view(xy):
    """Image of points of the board, and its derivatives."""
    seen = project(camera, pose, np.column_stack([xy - chess.xy.mean(axis=0), np.zeros(len(xy))]))
    return seen.xy, seen.d_point[:, :, :2]


# %%
# Three exposures. The standard deviations follow from the grey values alone; the truth is used only to
# check.
truth = dict(zip(chess.ids, view(chess.xy)[0], strict=True))
rng, rows = np.random.default_rng(2), []
figure, panels = plt.subplots(1, 3, figsize=(8.4, 3.1), layout="constrained")
for axes, blur in zip(panels, (0.6, 1.5, 3.0), strict=True):
    light = 30.0 + 170.0 * (1 - draw(squares.mapped(view).oriented(), (480, 640), blur))
    frame = reseau.Frame(Sensor(640, 480, gain=30.0, read_noise=1.5).expose(light, rng), 255.0)
    found = reseau.measure(frame, chess).required()
    error = found.points.xy - [truth[name] for name in found.points.names]
    ratio = np.sqrt(np.mean((error / found.points.sigma) ** 2))
    rows.append((blur, found.found, np.sqrt(np.mean(error**2)), np.median(found.points.sigma), ratio))
    found.plot(axes, frame)
    axes.plot(*found.points.xy.T, "o", color="#e05a3a", markersize=10, markerfacecolor="none")
    axes.set(xlim=(250, 390), ylim=(300, 195), xlabel="", ylabel="", xticks=[], yticks=[])
    axes.set_title(f"blur {blur} px: {rows[-1][2]:.3f} px", loc="left")

# %%
# Blur costs precision slowly: a corner uses all pixels along its four edges, and a wider edge is still a
# line.
print("blur  corners  error/px  sigma/px  error/sigma")
for row in rows:
    print("{:4.1f}  {:7d}  {:8.4f}  {:8.4f}  {:11.2f}".format(*row))
assert all(row[1] == len(chess.ids) for row in rows)
assert rows[0][2] < rows[1][2] < rows[2][2] < 0.1
assert all(0.75 < row[4] < 1.3 for row in rows)
