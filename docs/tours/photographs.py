"""Twelve photographs of the board of the tour, as a camera with barrel distortion takes them.

OpenCV draws the board and blurs it; nothing of reseau is used. Run it in the folder of the tour:
python photographs.py
"""

from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FX, FY, CX, CY = 720, 480, 690.0, 689.0, 363.4, 236.8
K1, K2, P1, P2 = -0.19, 0.05, 0.0008, -0.0005
COLUMNS, ROWS, SQUARE_MM, MARKER_MM = 7, 10, 23.0, 17.25
PER_MM, FINE = 12, 3  # samples of the board per mm, and of the image per pixel and direction

dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
board = cv2.aruco.CharucoBoard((COLUMNS, ROWS), SQUARE_MM, MARKER_MM, dictionary)
size_mm = np.array([COLUMNS, ROWS]) * SQUARE_MM
margin_mm = 20.0
w, h = (size_mm * PER_MM).astype(int)
sheet = cv2.copyMakeBorder(
    board.generateImage((int(w), int(h))), *[int(margin_mm * PER_MM)] * 4, cv2.BORDER_CONSTANT, value=255
)
sheet = cv2.GaussianBlur(25 + 0.7 * sheet.astype(np.float32), (0, 0), 1.5)

# Where each sample of the image looks: pixels are squares around their coordinates.
x, y = ((np.arange(n * FINE) + 0.5) / FINE - 0.5 for n in (WIDTH, HEIGHT))
seen_x, seen_y = np.meshgrid((x - CX) / FX, (y - CY) / FY)
u, v = seen_x, seen_y
for _ in range(15):  # the inverse of OpenCV's distortion, by its own iteration
    r2 = u * u + v * v
    radial = 1 + r2 * (K1 + r2 * K2)
    aside_x, aside_y = 2 * P1 * u * v + P2 * (r2 + 2 * u * u), P1 * (r2 + 2 * v * v) + 2 * P2 * u * v
    u, v = (seen_x - aside_x) / radial, (seen_y - aside_y) / radial

rng = np.random.default_rng(28)
Path("photos").mkdir(exist_ok=True)
for k in range(12):
    roll, lean = np.deg2rad(90 * (k % 4) + rng.uniform(-8, 8)), np.deg2rad((0, 32, 40)[k % 3])
    way = 2 * np.pi * (k / 12 + 0.1 * rng.uniform())
    turn = cv2.Rodrigues(lean * np.array([np.cos(way), np.sin(way), 0]))[0]
    turn = turn @ cv2.Rodrigues(np.array([0, 0, roll]))[0]
    distance = rng.uniform(330, 470)
    # The board in the middle, then in each corner of the image.
    aside = np.array([(0, 0), (-1, -1), (1, 1), (1, -1), (-1, 1)][k % 5]) * (0.24, 0.12)
    middle = np.array([*(aside * rng.uniform(0.8, 1.2, 2) * distance), distance])
    to_image = np.column_stack([turn[:, :2], middle - turn[:, :2] @ (size_mm / 2)])
    across, down, depth = (a * u + b * v + c for a, b, c in np.linalg.inv(to_image))
    light = cv2.remap(
        sheet,
        *(((mm / depth + margin_mm) * PER_MM - 0.5).astype(np.float32) for mm in (across, down)),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=110.0,
    )
    light = cv2.GaussianBlur(light, (0, 0), 0.6 * FINE)
    pixels = light.reshape(HEIGHT, FINE, WIDTH, FINE).mean(axis=(1, 3)) + rng.normal(0, 1.5, (HEIGHT, WIDTH))
    cv2.imwrite(f"photos/{k + 1:02}.png", np.clip(np.rint(pixels), 0, 255).astype(np.uint8))
    print(f"photos/{k + 1:02}.png")
