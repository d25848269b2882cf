"""Bundler's file and COLMAP's binary files hold the same network as the files that are read already."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reseau.bundle import Network, adjust_network, example_network
from reseau.core.errors import FormatError
from reseau.exchange.bal import read_bal
from reseau.exchange.bundler import read_bundler
from reseau.exchange.colmap import read_colmap
from reseau.exchange.networks import read_foreign
from reseau.optics.poses import matrix_to_vector, rotation_matrix

VIEW = np.diag([1.0, -1.0, -1.0])


def centred() -> tuple[Network, np.ndarray, np.ndarray]:
    """A network, rotations along −z, and coordinates from the middle of the image, y up."""
    values = adjust_network(example_network()).required().fit.values
    network = replace(
        example_network(), x0=values.x0, rotation=matrix_to_vector(values.rotation), xyz=values.xyz
    )
    camera = network.cameras[0]
    middle = [(camera.width - 1) / 2, (camera.height - 1) / 2]
    return network, VIEW @ rotation_matrix(network.rotation), (network.xy - middle) * [1, -1]


def bundler(folder: Path, *, lost: bool = False) -> Path:
    """The network as Bundler writes it, optionally with an image that was not oriented."""
    network, turns, xy = centred()
    lines = ["# Bundle file v0.3", f"{len(turns) + lost} {len(network.points)}"]
    for turn, x0 in zip(turns, network.x0, strict=True):
        lines += ["800 0.1 0.01", *(" ".join(map(repr, row)) for row in turn.tolist())]
        lines.append(" ".join(map(repr, (-turn @ x0).tolist())))
    lines += ["0 0 0"] * (5 * lost)
    for j, point in enumerate(network.xyz):
        rows = np.flatnonzero(network.point_of == j)
        lines += [" ".join(map(repr, point.tolist())), "255 0 0"]
        views = " ".join(f"{network.image_of[r]} 7 {xy[r, 0]!r} {xy[r, 1]!r}" for r in rows)
        lines.append(f"{len(rows)} {views}".replace("np.float64(", "").replace(")", ""))
    file = folder / "bundle.out"
    file.write_text("\n".join(lines) + "\n")
    return file


@pytest.mark.parametrize("lost", [False, True])
def test_bundlers_file_is_the_network_of_a_bal_file(lost: bool, tmp_path: Path) -> None:
    network, turns, xy = centred()
    poses = [
        [*turn, *(-matrix @ x0), 800.0, 0.1, 0.01]
        for turn, matrix, x0 in zip(matrix_to_vector(turns), turns, network.x0, strict=True)
    ]
    order = np.lexsort([network.image_of, network.point_of])
    table = np.column_stack([network.image_of, network.point_of, xy])[order]
    text = f"{len(poses)} {len(network.points)} {len(xy)}\n"
    text += "\n".join(f"{int(i)} {int(j)} {x!r} {y!r}" for i, j, x, y in table.tolist())
    text += "\n" + "\n".join(repr(float(v)) for row in [*poses, *network.xyz] for v in row)
    (tmp_path / "block.txt").write_text(text)
    bal, found = read_bal(tmp_path / "block.txt"), read_foreign(bundler(tmp_path, lost=lost))
    assert found.images == bal.images
    assert (found.image_of == bal.image_of).all()
    assert (found.point_of == bal.point_of).all()
    for name in ("x0", "rotation", "xyz", "xy"):
        assert np.abs(getattr(found, name) - getattr(bal, name)).max() < 1e-9
    assert all((a.values == b.values).all() for a, b in zip(found.cameras, bal.cameras, strict=True))


def test_images_have_the_names_of_the_list(tmp_path: Path) -> None:
    file = bundler(tmp_path)
    (tmp_path / "list.txt").write_text("".join(f"img{k}.jpg 0 650.2\n" for k in range(8)))
    found = read_bundler(file)
    assert found.images[:2] == ("img0.jpg", "img1.jpg")
    assert found.files == found.images


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace("v0.3", "v0.9"), "first line"),
        (lambda text: text[: len(text) // 2], "ends too early"),
        (lambda text: text.replace("255 0 0", "255 red 0", 1), "not numbers"),
    ],
)
def test_a_bad_file_of_bundler_is_one_line(change, said: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    file = bundler(tmp_path)
    file.write_text(change(file.read_text()))
    with pytest.raises(FormatError, match=said):
        read_bundler(file)


def binary(folder: Path, kind: int = 5) -> None:
    """Two images of two points by a fisheye camera, as COLMAP's binary files."""
    values = (500.0, 510.0, 320.0, 240.0, 0.05, -0.01, 0.002, 0.0)
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ8d", 1, 3, kind, 640, 480, *values))
    points = b"".join(
        struct.pack("<Q3d3BdQ", 10 + j, 0.5 * j, -0.2, 4.0, 1, 2, 3, 0.5, 2) + struct.pack("<4i", 1, j, 2, j)
        for j in range(2)
    )
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 2) + points)
    images = b"".join(
        struct.pack("<i7di", i + 1, 1.0, 0, 0, 0, -0.3 * i, 0.0, 0.0, 3)
        + f"ünter {i}.jpg".encode()
        + b"\0"
        + struct.pack("<Q2dq2dq2dq", 3, 300.5, 200.5, 10, 340.5, 201.5, 11, 7.0, 7.0, -1)
        for i in range(2)
    )
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2) + images)


def test_colmaps_binary_files_are_read(tmp_path: Path) -> None:
    binary(tmp_path)
    found = read_foreign(tmp_path)
    assert found.images == ("ünter 0.jpg", "ünter 1.jpg")
    assert found.points == ("10", "11")
    assert found.cameras[0].model == "fisheye"
    assert found.cameras[0].values.tolist()[:3] == [500.0, 510.0, 319.5]
    assert found.xy.tolist() == [[300.0, 200.0], [340.0, 201.0]] * 2
    assert found.x0.tolist() == [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]


def test_binary_files_that_end_or_have_an_unknown_model_are_one_line(tmp_path: Path) -> None:
    binary(tmp_path, kind=12)
    with pytest.raises(FormatError, match="model number 12"):
        read_colmap(tmp_path)
    binary(tmp_path)
    for name in ("cameras", "points3D", "images"):
        file = tmp_path / f"{name}.bin"
        content = file.read_bytes()
        file.write_bytes(content[:-5])
        with pytest.raises(FormatError, match="ends too early"):
            read_colmap(tmp_path)
        file.write_bytes(content)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"])
def test_binary_and_text_files_of_colmap_itself_agree(model: str, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap (extra `peers`)")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, 3, 40
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    if model != "SIMPLE_RADIAL":
        distortion = [0.02, -0.01, 0.003, 0.0] + [0.0] * 4 * (model == "FULL_OPENCV")
        options.camera_params = [900.0, 900.0, 512.0, 384.0, *distortion]
    drawn = pycolmap.synthesize_dataset(options)
    for name in ("text", "binary"):
        (tmp_path / name).mkdir()
        getattr(drawn, f"write_{name}")(tmp_path / name)
    one, other = read_colmap(tmp_path / "text"), read_colmap(tmp_path / "binary")
    assert one.images == other.images
    assert set(one.points) == set(other.points)
    assert np.abs(one.xy - other.xy).max() < 1e-9
    assert all((a.values == b.values).all() for a, b in zip(one.cameras, other.cameras, strict=True))
