"""Which photographs of several cameras were taken at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reseau.core.errors import ArchiveError, InputError, UsageError
from reseau.io.images import write_image
from reseau.procedures.exposures import (
    exposures_of_files,
    files_left_out,
    files_of,
    photograph_reader,
    photographs_in,
    photographs_of,
)
from reseau.procedures.target_measurement import Unread


def exposures(**files: str) -> dict[str, str]:
    found = exposures_of_files({name: [Path(path) for path in text.split()] for name, text in files.items()})
    return {name: taken.exposure for name, (_, taken) in found.items()}


def test_files_with_the_same_name_were_taken_at_once() -> None:
    found = exposures(left="a/0001.png a/17x3.png", right="b/17x3.tif b/0002.png")
    assert found == {
        "left/0001.png": "0001", "left/17x3.png": "17x3", "right/17x3.tif": "17x3", "right/0002.png": "0002",
    }  # fmt: skip


def test_otherwise_files_with_the_same_last_number_were() -> None:
    found = exposures(left="left01.jpg left02.jpg", right="right_2.jpg right_3_b.jpg")
    assert list(found.values()) == ["1", "2", "2", "3"]


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"left": "1.png"}, "at least two are required"),
        ({"left": "x.png", "right": "1.png"}, "x.png: has no number"),
        ({"left": "a1.png", "right": "b2.png"}, "no file was taken together"),
        (
            {"left": "a1.png a01.png", "right": "b1.png"},
            "left: has a1.png and a01.png of one exposure",
        ),
    ],
)
def test_names_that_do_not_tell_it_are_refused(files: dict[str, str], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        exposures(**files)


def test_files_are_those_of_a_folder_or_of_a_pattern(tmp_path: Path) -> None:
    for name in ("b.png", "a.png", ".hidden", "a.txt"):
        (tmp_path / name).touch()
    (tmp_path / "inner").mkdir()
    assert [path.name for path in files_of(str(tmp_path))] == ["a.png", "b.png"]
    assert [path.name for path in files_of(str(tmp_path / "a*"))] == ["a.png", "a.txt"]
    assert [path.name for path in files_of(str(tmp_path / "*.png"))] == ["a.png", "b.png"]
    with pytest.raises(InputError, match="has no photograph"):
        files_of(str(tmp_path / "inner"))
    with pytest.raises(InputError, match="matches no file"):
        files_of(str(tmp_path / "*.jpg"))


@pytest.mark.parametrize("again", [False, True])
def test_a_photograph_is_read_from_the_store_unless_it_changed_there(tmp_path: Path, again: bool) -> None:
    store, image = tmp_path / "store", np.arange(20, dtype=np.uint8).reshape(4, 5)
    write_image(tmp_path / "a.png", image)

    def photograph() -> Unread:
        _, found = photographs_of([("a", tmp_path / "a.png")], photograph_reader(), store=str(store))
        (one,) = found
        assert isinstance(one, Unread)
        return one

    one = photograph()
    (path,) = store.glob("*/*.png")
    write_image(path, image[::-1])
    if again:
        one = photograph()
        assert np.array_equal(one.read().pixels, image)
    else:
        with pytest.raises(ArchiveError, match="has been changed"):
            one.read()


def test_undistorted_images_beside_their_photographs_are_not_photographs_of_the_camera(
    tmp_path: Path,
) -> None:
    for name in ("1.png", "2.png", "1-undistorted.png", "1-undistorted.json", "3-undistorted.png"):
        (tmp_path / name).touch()
    # One without its camera beside it may be a name that somebody chose.
    assert [path.name for path in photographs_in(tmp_path)] == ["1.png", "2.png", "3-undistorted.png"]
    line = files_left_out(tmp_path)
    assert line.endswith(": 1-undistorted.png: not used, undistorted by `reseau apply`")
    (tmp_path / "notes.txt").touch()
    assert files_left_out(tmp_path).endswith("undistorted by `reseau apply`, nor 1 other files")
