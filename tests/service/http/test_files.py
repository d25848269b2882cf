"""Photographs that are dropped become a calibration; what is no photograph does no harm."""

from __future__ import annotations

import json
import os
import random
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest

from reseau.archive import Archive
from reseau.archive.verification import verify
from reseau.core.errors import ImageError
from reseau.core.tone import ToneCurve
from reseau.service.decoding import Decoder, DecodingLimits

from ...capture.fieldrig import DESIGN
from .served import Served, TestClient, served


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


@pytest.mark.slow
def test_photographs_become_a_calibration_with_a_verdict_that_is_computed_again(
    one: Served, photographs: dict[str, bytes]
) -> None:
    client = one.client("operate")
    files = photographs | {"../../notes.png": b"no photograph"}
    given = {"pitch_mm": "0.027", "free": "c,x0,y0,K1"}
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
    assert "usable" in calibration["assessment"]["lines"][0]
    page = one.client().get("/sessions/dropped").text
    assert "sable for" in page
    again = client.post("/api/1/sessions/dropped/rerun")
    assert again.status_code == 202
    assert finished(client, again.json()["number"])["found"] == {
        "calibration.json": True,
        "report.html": True,
        "scene.json": True,
    }
    assert verify(one.service.archive)


@pytest.mark.slow
def test_an_upload_that_was_cut_off_is_finished_after_the_next_start(
    tmp_path: Path, photographs: dict[str, bytes]
) -> None:
    with served(tmp_path) as first:
        client = first.client("operate")
        assert sent(client, "cut off", photographs, pitch_mm="0.027", free="c,x0,y0").status_code == 202
    with served(tmp_path) as second:
        client = second.client("operate")
        end = time.monotonic() + 120
        while client.get("/api/1/sessions/cut off").json()["status"] == "not ended":
            assert time.monotonic() < end
            time.sleep(0.05)
        found = client.get("/api/1/sessions/cut off").json()
        assert (found["status"], found["good"], len(found["results"])) == ("done", 4, 3)


@pytest.mark.slow
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
        ({"a.png": b"x"}, {"pitch_mm": "-1"}, "pitch_mm"),
        ({"a.png": b"x"}, {"subject": "oscilloscope"}, "PHOTO I and II"),
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


@pytest.mark.parametrize("name", ["a/b", " ", "a\nb", ".a", "a\\b"])
def test_an_upload_under_a_name_that_is_none_is_refused_as_a_wrong_input(one: Served, name: str) -> None:
    answer = sent(one.client("operate"), name, {"a.png": b"x"})
    assert (answer.status_code, answer.json()["error"]["code"]) == (422, "usage")
    assert "valid name of a session" in answer.json()["error"]["text"]


@pytest.mark.slow
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


@pytest.fixture(scope="module")
def decoder() -> Iterator[Decoder]:
    with Decoder() as found:
        yield found


@pytest.mark.parametrize("kind", [".png", ".jpg", ".tif", ".bmp"])
def test_a_damaged_photograph_is_a_frame_or_an_error(kind: str, tmp_path: Path, decoder: Decoder) -> None:
    count = int(os.environ.get("RESEAU_DAMAGED", "25"))
    pixels = np.random.default_rng(1).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    _, coded = cv2.imencode(kind, pixels)
    path = tmp_path / f"photograph{kind}"
    before = 0
    for seed in range(count):
        path.write_bytes(damaged(coded.tobytes(), seed))
        with suppress(ImageError):
            assert decoder.frame(path, "a").pixels.ndim == 2
        if seed == 10:
            before = resident(decoder)
    assert resident(decoder) < before + (4 << 20)


def resident(decoder: Decoder) -> int:
    """Memory of the process of a decoder (bytes)."""
    assert decoder._process is not None
    return int(psutil.Process(decoder._process.pid).memory_info().rss)


@pytest.mark.slow
def test_photographs_are_decoded_by_one_process_each_in_a_child(tmp_path: Path, decoder: Decoder) -> None:
    grey = np.random.default_rng(2).integers(0, 255, (30, 50), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), grey)
    decoder.frame(tmp_path / "a.png", "a")
    first = decoder._process
    assert first is not None
    for _ in range(20):
        assert np.array_equal(decoder.frame(tmp_path / "a.png", "a").pixels, grey)
    assert decoder._process is first
    first.kill()  # the next one starts another
    with suppress(ImageError):
        decoder.frame(tmp_path / "a.png", "a")
    assert np.array_equal(decoder.frame(tmp_path / "a.png", "a").pixels, grey)


def test_colours_resolution_and_tone_curve_of_a_scan_are_kept(tmp_path: Path, decoder: Decoder) -> None:
    import tifffile

    pixels = np.random.default_rng(3).integers(0, 65535, (30, 50, 3), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", resolution=(2400, 2400), resolutionunit=2)
    scan = decoder.scan(tmp_path / "a.tif", "a")
    assert (scan.channels, scan.dpi, scan.full_scale) == (("red", "green", "blue"), 2400.0, 65535.0)
    assert np.array_equal(scan.window(0, 30, 0, 50), pixels)
    with Archive.open(tmp_path / "archive", create=True) as archive:
        session = archive.begin("roll", "film", {})
        curved = replace(scan, curve=ToneCurve(None, (0.0, 0.2, 1.0), "a table"))
        kept = session.scan(session.store("a", curved))
        assert np.array_equal(kept.window(0, 30, 0, 50), pixels)
        assert (kept.dpi, kept.curve) == (2400.0, curved.curve)


@pytest.mark.slow
def test_a_photograph_with_too_many_pixels_or_bytes_in_memory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "photograph.png"
    _, coded = cv2.imencode(".png", np.zeros((2000, 3000), np.uint8))
    path.write_bytes(coded.tobytes())
    with Decoder(DecodingLimits(pixels=1_000_000)) as few, pytest.raises(ImageError, match="pixels"):
        few.frame(path, "a")
    with (
        Decoder(DecodingLimits(memory=200 << 20, seconds=60)) as small,
        pytest.raises(ImageError, match=r"memory|damaged"),
    ):
        small.frame(path, "a")


def film(seed: int) -> np.ndarray[Any, Any]:
    """A scan of a frame of 36 mm × 24 mm with 20 px/mm, its corners at (60, 50) and (780, 530)."""
    import cv2

    draw = np.random.default_rng(seed)
    picture = cv2.resize(draw.uniform(60, 220, (12, 18)).astype(np.float32), (720 * 4, 480 * 4))
    fine = np.full((580 * 4, 840 * 4), 8, np.float32)
    fine[50 * 4 : 530 * 4, 60 * 4 : 780 * 4] = picture
    grey = cv2.resize(cv2.GaussianBlur(fine, (0, 0), 4.0), (840, 580), interpolation=cv2.INTER_AREA)
    noisy = grey[:, :, None] + draw.normal(0, 1.5, (580, 840, 3))
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_scans_of_film_are_archived_and_oriented(one: Served) -> None:
    client = one.client("operate")
    scans = {"07.png": film(7), "08.png": np.full((580, 840), 128, np.uint8)}
    parts = [("photographs", (name, cv2.imencode(".png", each)[1].tobytes())) for name, each in scans.items()]
    given = {"name": "roll 12", "subject": "film", "format_mm": "36x24"}
    begun = client.post("/api/1/uploads", data=given, files=parts)
    assert begun.status_code == 202, begun.text
    assert finished(client, begun.json()["job"])["found"] == "done"
    found = client.get("/api/1/sessions/roll 12").json()
    names = {each["name"]: each["id"] for each in found["results"]}
    assert set(names) == {"orientation 07.json", "orientation 08.json", "summary.json", "report.html"}
    base = "/api/1/sessions/roll 12"
    seven = client.get(f"{base}/results/{names['orientation 07.json']}/file").json()
    assert seven["status"] == "oriented"
    # The edge is between the pixels 59 and 60, at 59.5.
    for corner, (x, y) in {"ul": (59.5, 49.5), "lr": (779.5, 529.5)}.items():
        at = seven["corners"][corner]
        assert (at["x"], at["y"]) == pytest.approx((x, y), abs=0.1)
    eight = client.get(f"{base}/results/{names['orientation 08.json']}/file").json()
    assert (eight["status"], eight["why"]) == ("declined", "is of one tone; scan it with more exposure")
    rows = {(f["step"], f["kind"]): f for f in client.get(f"{base}/frames").json()}
    assert rows["08.png", "frame"]["measured"]["found"] == eight["why"]
    assert client.get(f"{base}/frames/{rows['07.png', 'frame']['id']}/preview.jpg").status_code == 200
    assert "2 frames: 1 oriented, 1 declined." in one.client().get("/sessions/roll 12").text


@pytest.mark.slow
def test_photographs_of_an_oscilloscope_of_other_origin_are_corrected_to_the_truth(
    one: Served, reference_data: Callable[[str], Path]
) -> None:
    folder = reference_data("independent") / "oscilloscope"
    truth = json.loads((folder / "set01.truth.json").read_text())["photos"]["III"]["check"]
    client = one.client("operate")
    files = [("photographs", (f"{k}.png", (folder / f"set01.photo{k}.png").read_bytes())) for k in (1, 2, 3)]
    for role, name in (("design", "reseau"), ("test_object", "object")):
        files.append((role, (f"{name}.json", (folder / f"set01.{name}.design.json").read_bytes())))
    begun = client.post("/api/1/uploads", data={"name": "scope", "subject": "oscilloscope"}, files=files)
    assert finished(client, begun.json()["job"])["found"] == "done"
    found = client.get("/api/1/sessions/scope").json()
    names = {each["name"]: each["id"] for each in found["results"]}
    assert set(names) == {"calibration.json", "true.csv", "report.html"}
    rows = client.get(f"/api/1/sessions/scope/results/{names['true.csv']}/file").text.splitlines()[1:]
    points = np.array([[float(v) for v in row.split(",")[1:3]] for row in rows])
    xy = np.column_stack([truth["object_X_mm"], truth["object_Y_mm"]])
    off = np.array([np.hypot(*(points - each).T).min() for each in xy[np.array(truth["visible"])]])
    assert np.median(off) < 0.01  # mm; 0.1 px of the photographs
    assert "Camera and oscilloscope are corrected" in one.client().get("/sessions/scope").text
    again = client.post("/api/1/sessions/scope/rerun")
    assert set(finished(client, again.json()["number"])["found"].values()) == {True}
