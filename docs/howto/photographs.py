"""What some how-to pages begin with, drawn by OpenCV; nothing of reseau is used.

python photographs.py rig          # left/, right/: a board before two cameras that are fixed to each other
python photographs.py turntable    # table/, angles.csv: a board on a turntable
python photographs.py wires        # frame.png: an ultrasonic scan of an N-wire phantom
python photographs.py points       # network.json: points in eight images, with two errors
python photographs.py tele         # tele/: images of a plate of circles by parallel rays
python photographs.py rolling      # rolling/: images of a moving board, line after line
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FINE = 640, 480, 3  # samples of the image per pixel and direction
COLUMNS, ROWS, SQUARE_MM, MARKER_MM, PER_MM = 7, 10, 23.0, 17.25, 12
SIZE_MM, MARGIN_MM = np.array([COLUMNS, ROWS]) * SQUARE_MM, 20.0
RNG = np.random.default_rng(7)


def printed():
    """The board on paper."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((COLUMNS, ROWS), SQUARE_MM, MARKER_MM, dictionary)
    picture = board.generateImage(tuple(int(mm * PER_MM) for mm in SIZE_MM))
    paper = cv2.copyMakeBorder(picture, *[int(MARGIN_MM * PER_MM)] * 4, cv2.BORDER_CONSTANT, value=255)
    return cv2.GaussianBlur(25 + 0.7 * paper.astype(np.float32), (0, 0), 1.5)


def photograph(path, sheet, camera, turn, middle):
    """Write what a camera (fx, fy, cx, cy, k1, k2) sees of the board; `middle` is the place of its middle."""
    fx, fy, cx, cy, k1, k2 = camera
    # Where each sample of the image looks: pixels are squares around their coordinates.
    x, y = ((np.arange(n * FINE) + 0.5) / FINE - 0.5 for n in (WIDTH, HEIGHT))
    seen = np.stack(np.meshgrid((x - cx) / fx, (y - cy) / fy))
    flat = seen
    for _ in range(25):  # the inverse of OpenCV's distortion, by its own iteration
        r2 = (flat**2).sum(axis=0)
        flat = seen / (1 + r2 * (k1 + r2 * k2))
    to_image = np.column_stack([turn[:, :2], middle - turn[:, :2] @ (SIZE_MM / 2)])
    across, down, depth = (a * flat[0] + b * flat[1] + c for a, b, c in np.linalg.inv(to_image))
    at = [((mm / depth + MARGIN_MM) * PER_MM - 0.5).astype(np.float32) for mm in (across, down)]
    light = cv2.remap(sheet, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110.0)
    light = cv2.GaussianBlur(light, (0, 0), 0.6 * FINE)
    pixels = light.reshape(HEIGHT, FINE, WIDTH, FINE).mean(axis=(1, 3))
    write(path, pixels + RNG.normal(0, 1.5, pixels.shape))


def write(path, pixels):
    """Write an image of 8 bit."""
    Path(path).parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), np.clip(np.rint(pixels), 0, 255).astype(np.uint8))
    print(path)


def turned(*degrees):
    """A rotation about x, y, then z."""
    x, y, z = (cv2.Rodrigues(row)[0] for row in np.diag(np.deg2rad(degrees)))
    return z @ y @ x


def rig():
    """Twelve exposures; the right camera stands 90 mm beside the left one, turned by 6 degrees."""
    sheet, beside = printed(), turned(1.0, 5.9, -0.5)
    for k in range(12):
        lean, way = (0, 30, 38)[k % 3], 2 * np.pi * k / 12
        turn = turned(lean * np.sin(way), lean * np.cos(way), 90 * (k % 4) + 8 * np.sin(k))
        place = (k % 5 != 0) * np.array([(-1) ** k, (-1) ** (k // 2)]) * (70.0, 50.0)
        middle = np.array([place[0] + 45, place[1], 330.0 + 25 * (k % 3)])
        photograph(f"left/{k + 1:02}.png", sheet, (530, 531, 322, 235, -0.28, 0.08), turn, middle)
        middle = beside @ (middle - (90, 2, -4))
        photograph(f"right/{k + 1:02}.png", sheet, (545, 544, 314, 241, -0.25, 0.06), beside @ turn, middle)


def turntable():
    """The board turns about an axis behind it; between two series the camera was moved by hand."""
    sheet, rows = printed(), ["image,angle_deg,sigma_deg,pose"]
    axis, beside = np.array([0.1, 1.0, 0.05]), np.array([20.0, 0.0, 30.0])
    axis /= np.linalg.norm(axis)
    for pose, rest in enumerate((turned(30, 0, 3), turned(-25, 10, 92))):
        for k, angle in enumerate((-40, -25, -10, 5, 20, 35)):
            turn = rest @ cv2.Rodrigues(np.deg2rad(angle) * axis)[0]
            middle = np.array([0, 0, 430.0]) + (rest - turn) @ beside
            name = f"{6 * pose + k + 1:02}.png"
            photograph(f"table/{name}", sheet, (900, 901, 322, 235, -0.28, 0.08), turn, middle)
            rows.append(f"{name},{angle + 0.05 * RNG.normal():.3f},0.05,{pose}")
    Path("angles.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def table(path, xy, size, sigma=0.02):
    """Write the points in an image, with noise: x right and y down from the middle of the first pixel."""
    Path(path).parent.mkdir(exist_ok=True)
    seen = [(k, *(point + RNG.normal(0, sigma, 2))) for k, point in enumerate(xy)]
    inside = [(k, x, y) for k, x, y in seen if 5 < x < size[0] - 5 and 5 < y < size[1] - 5]
    rows = [f"{k},{x:.5f},{y:.5f},{sigma},{sigma}" for k, x, y in inside]
    Path(path).write_text("\n".join(["id,x,y,sx,sy", *rows]) + "\n", encoding="utf-8")


def tele():
    """Sixteen images of 9 x 7 circles, 1 mm apart, in pixels of 3.45 um: m = 0.5, K1 = -0.002 / mm2."""
    at = np.array([(x - 4, y - 3, 0.0) for y in range(7) for x in range(9)])
    for k in range(16):
        lean, way = (0, 18, 25)[k % 3], 2 * np.pi * k / 12
        turn = turned(lean * np.sin(way), lean * np.cos(way), 90 * (k % 4) + 8 * np.sin(k))
        mm = 0.5 * ((at @ turn.T)[:, :2] + RNG.uniform(-0.3, 0.3, 2))
        mm *= 1 - 0.002 * (mm**2).sum(axis=1, keepdims=True)
        table(f"tele/{k:02}.csv", mm / 0.00345 + (639.5, 511.5), (1280, 1024))


def rolling():
    """Twelve images of a board that moves by 0.2 m/s, 0.2 rad/s; fx 1506.4, k3 0.061, 23 us a line."""
    board = np.array(
        [(x * SQUARE_MM, y * SQUARE_MM, 0.0) for y in range(ROWS - 1) for x in range(COLUMNS - 1)]
    )
    matrix = np.array([[1506.4, 0, 948.2], [0, 1507.1, 546.1], [0, 0, 1]])
    k1_k2_p1_p2_k3 = np.array([0.082, -0.163, 4e-4, -7e-4, 0.061])
    for k in range(12):
        lean, way = (0, 30, 38)[k % 3], 2 * np.pi * k / 12
        turn = turned(lean * np.sin(way), lean * np.cos(way), 90 * (k % 4) + 8 * np.sin(k))
        place = (k % 5 != 0) * np.array([(-1) ** k, (-1) ** (k // 2)]) * (110.0, 50.0)
        middle = np.array([*place, 300.0 + 25 * (k % 3)])
        speed, spin = RNG.normal(0, (200, 200, 100)), RNG.normal(0, 0.2, 3)  # of the board, mm/s and rad/s
        xy = np.full((len(board), 2), 540.0)
        for _ in range(6):  # the line of a point tells when it was seen, and where it was then
            for j, time in enumerate(23.148148e-6 * (xy[:, 1] - 539.5)):
                now = cv2.Rodrigues(time * spin)[0]
                at = now @ (turn @ (board[j] - board.mean(axis=0)) + middle) + time * speed
                none = np.zeros(3)
                xy[j] = cv2.projectPoints(at[None], none, none, matrix, k1_k2_p1_p2_k3)[0][0, 0]
        table(f"rolling/{k:02}.csv", xy, (1920, 1080))


def wires():
    """Nine echoes, 9 px/mm: narrow along the beam, wide across it. N1 to N3 are cut at 0.3, 0.55, 0.8."""
    at_mm = [(20, 0), (8, 0), (-20, 0), (20, 15), (2, 15), (-20, 15), (12, 30), (-13.6, 30), (-20, 30)]
    y, x = np.mgrid[0:480, 0:620]
    echoes = sum(
        np.exp(-(((x - 310.25 - 9 * mm_x) / 7) ** 2) / 2 - ((y - 110.4 - 9 * mm_y) / 1.6) ** 2 / 2)
        for mm_x, mm_y in at_mm
    )
    write("frame.png", 5 + 150 * echoes + RNG.normal(0, 1.5, echoes.shape))


def points():
    """Forty points in eight images; of four distances one is in centimetres, two names are exchanged."""
    xyz = RNG.uniform((-300, -220, -80), (300, 220, 80), (40, 3))
    matrix, k1 = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), np.array([-0.1, 0, 0, 0])
    seen = []
    for k in range(8):
        lean, way = 30 * (k > 0), 2 * np.pi * k / 7
        turn = turned(lean * np.sin(way), lean * np.cos(way), 90 * (k % 4))
        seen.append(cv2.projectPoints(xyz, cv2.Rodrigues(turn)[0], np.array([0, 0, 1150.0]), matrix, k1)[0])
    xy = np.reshape(seen, (8, 40, 2)) + RNG.normal(0, 0.05, (8, 40, 2))
    xy[5, [3, 4]] = xy[5, [4, 3]]
    ends = np.array([[0, 1], [2, 3], [4, 5], [6, 7]])
    length = np.linalg.norm(xyz[ends[:, 0]] - xyz[ends[:, 1]], axis=1) + RNG.normal(0, 0.05, 4)
    length[2] /= 10
    names = np.array([f"p{j}" for j in range(40)])
    Path("network.json").write_text(json.dumps({
        "schema": "reseau-network/1", "unit": "mm", "datum": "free",
        "cameras": [{"id": "cam", "model": "opencv", "width": 640, "height": 480,
                     "parameters": {"fx": 790, "fy": 790, "cx": 320, "cy": 240},
                     "free": ["fx", "fy", "cx", "cy", "k1"]}],
        "images": {"id": [f"i{k}" for k in range(8)], "camera": ["cam"] * 8, "X0": [None] * 8,
                   "rotation": [None] * 8},
        "points": {"id": names.tolist(), "xyz": [None] * 40, "sigma": [None] * 40, "role": ["tie"] * 40},
        "observations": {"image": [f"i{k // 40}" for k in range(320)], "point": [*names] * 8,
                         "x": xy[..., 0].ravel().tolist(), "y": xy[..., 1].ravel().tolist(),
                         "sx": [0.05] * 320, "sy": [0.05] * 320},
        "distances": {"from": names[ends[:, 0]].tolist(), "to": names[ends[:, 1]].tolist(),
                      "length": length.tolist(), "sigma": [0.05] * 4},
    }))  # fmt: skip


if __name__ == "__main__":
    globals()[sys.argv[1]]()
