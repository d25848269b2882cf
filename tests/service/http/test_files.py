"""Photographs that are dropped become a calibration; what is no photograph does no harm."""

from __future__ import annotations

import os
import random
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reseau.archive import Archive, verify
from reseau.core.errors import ImageError
from reseau.service.decoding import DecodingLimits, decode

from ...capture.fieldrig import DESIGN
from .served import Served, TestClient, served


@pytest.fixture(scope="module")
def one(archived: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("files")
    shutil.copytree(archived, folder, dirs_exist_ok=True)
    with served(folder) as found:
        yield found


@pytest.fixture(scope="module")
def photographs(one: Served) -> dict[str, bytes]:
    """The frames of session `monday` as PNG."""
    with Archive.open(one.service.archive.place) as archive:
        session = archive.session("monday")
        found = {}
        for each in session.frames(kind="frame"):
            _, coded = cv2.imencode(".png", session.picture(each).pixels)
            found[f"{each.step} {each.take}.png"] = coded.tobytes()
        return found


def sent(client: TestClient, name: str, files: dict[str, bytes], **given: Any) -> Any:
    parts = [("photographs", (each, content)) for each, content in files.items()]
    design = ("design", ("field.json", given.pop("design", DESIGN.to_json())))
    return client.post("/api/1/uploads", data={"name": name, **given}, files=[*parts, design])


def finished(client: TestClient, number: int) -> dict[str, Any]:
    end = time.monotonic() + 120
    while (job := client.get(f"/api/1/jobs/{number}").json())["state"] in ("waiting", "running"):
        assert time.monotonic() < end
        time.sleep(0.05)
    found: dict[str, Any] = job
    return found


def test_photographs_become_a_calibration_with_a_verdict_that_is_computed_again(
    one: Served, photographs: dict[str, bytes]
) -> None:
    client = one.client("operate")
    files = photographs | {"../../notes.png": b"no photograph"}
    given = {"pitch": "0.027", "free": "c,x0,y0,K1"}
    begun = sent(client, "dropped", files, **given)
    assert begun.status_code == 202, begun.text
    assert finished(client, begun.json()["job"])["found"] == "done"
    found = client.get("/api/1/sessions/dropped").json()
    assert (found["status"], found["good"]) == ("done", 4)
    rows = client.get("/api/1/sessions/dropped/frames").json()
    originals = {each["step"]: each for each in rows if each["kind"] == "photograph"}
    assert set(originals) == {*photographs, "notes.png"}
    assert originals["notes.png"]["ok"] is False
    dark = next(each for each in found["rejected"] if each["step"] == "right 0.png")
    assert dark["why"]
    kept = client.get(f"/api/1/sessions/dropped/frames/{originals['frontal 0.png']['id']}/file")
    assert kept.content == photographs["frontal 0.png"]
    result = next(each for each in found["results"] if each["name"] == "calibration.json")
    calibration = client.get(f"/api/1/sessions/dropped/results/{result['id']}/file").json()
    c = calibration["parameters"]["c"]
    assert abs(c["value"] - 57.5) < 4 * c["sigma"] + 1e-3
    assert "usable" in calibration["validity"]["assessment"]["lines"][0]
    page = one.client().get("/sessions/dropped").text
    assert "usable" in page
    again = client.post("/api/1/sessions/dropped/rerun")
    assert again.status_code == 202
    assert finished(client, again.json()["number"])["found"] == {
        "calibration.json": True,
        "report.html": True,
    }
    assert verify(one.service.archive)


@pytest.mark.slow
def test_an_upload_that_was_cut_off_is_finished_after_the_next_start(
    tmp_path: Path, photographs: dict[str, bytes]
) -> None:
    with served(tmp_path) as first:
        client = first.client("operate")
        assert sent(client, "cut off", photographs, pitch="0.027", free="c,x0,y0").status_code == 202
    with served(tmp_path) as second:
        client = second.client("operate")
        end = time.monotonic() + 120
        while client.get("/api/1/sessions/cut off").json()["status"] == "not ended":
            assert time.monotonic() < end
            time.sleep(0.05)
        found = client.get("/api/1/sessions/cut off").json()
        assert (found["status"], found["good"], len(found["results"])) == ("done", 4, 2)


@pytest.mark.parametrize(
    ("files", "given", "what"),
    [
        ({"a.exe": b"MZ"}, {}, "is not a photograph"),
        ({"a.pkl": b"\x80\x04."}, {}, "is not a photograph"),
        ({"a.png": b""}, {}, "is empty"),
        ({"a.png": b"x"}, {"design": "no JSON"}, "is not JSON"),
        ({"a.png": b"x"}, {"design": "[" * 100_000}, "is not JSON"),
        ({"a.png": b"x"}, {"design": "{}"}, "schema"),
        ({"a.png": b"x"}, {"model": "no such model"}, "no such model"),
        ({"a.png": b"x"}, {"pitch": "-1"}, "pitch"),
        ({"a.png": b"x"}, {"target": "oscilloscope"}, "PHOTO I and II"),
    ],
)  # fmt: skip
def test_what_cannot_be_calibrated_is_refused_in_one_line_and_leaves_no_session(
    one: Served, files: dict[str, bytes], given: dict[str, str], what: str
) -> None:
    client = one.client("operate")
    answer = sent(client, "refused", files, **given)
    assert answer.status_code == 422, answer.text
    assert what in answer.json()["error"]["text"]
    assert client.get("/api/1/sessions/refused").status_code == 404


def test_an_upload_without_a_usable_photograph_fails_with_a_reason(one: Served) -> None:
    client = one.client("operate")
    begun = sent(client, "nothing", {f"{k}.jpg": b"nothing" for k in range(3)})
    assert finished(client, begun.json()["job"])["found"] == "failed"
    found = client.get("/api/1/sessions/nothing").json()
    assert found["status"] == "failed"
    assert found["why"]


def damaged(coded: bytes, seed: int) -> bytes:
    """A file with changed, missing or repeated bytes."""
    draw = random.Random(seed)
    data = bytearray(coded)
    for _ in range(draw.randint(1, 30)):
        data[draw.randrange(len(data))] = draw.randrange(256)
    if draw.random() < 0.3:
        del data[draw.randrange(len(data)) :]
    if draw.random() < 0.2:
        data += data[: draw.randrange(1000)]
    return bytes(data)


@pytest.mark.parametrize("kind", [".png", ".jpg", ".tif", ".bmp"])
def test_a_damaged_photograph_is_a_frame_or_an_error(kind: str, tmp_path: Path) -> None:
    count = int(os.environ.get("RESEAU_DAMAGED", "1"))
    pixels = np.random.default_rng(1).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    _, coded = cv2.imencode(kind, pixels)
    path = tmp_path / f"photograph{kind}"
    for seed in range(count):
        path.write_bytes(damaged(coded.tobytes(), seed))
        with suppress(ImageError):
            assert decode(path, "a").pixels.ndim == 2


def test_a_photograph_with_too_many_pixels_or_bytes_in_memory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "photograph.png"
    _, coded = cv2.imencode(".png", np.zeros((2000, 3000), np.uint8))
    path.write_bytes(coded.tobytes())
    with pytest.raises(ImageError, match="pixels"):
        decode(path, "a", DecodingLimits(pixels=1_000_000))
    with pytest.raises(ImageError, match="memory"):
        decode(path, "a", DecodingLimits(memory=200 << 20, seconds=2))
