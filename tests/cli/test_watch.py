"""`reseau watch` on the simulated bench: still, sharp and new frames; a page for this machine only."""

from __future__ import annotations

import http.client
import json
import signal
from collections.abc import Iterator
from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from reseau.cli import run
from reseau.core.data import Frame, ImagePoints
from reseau.core.errors import ConnectionLost
from reseau.core.failure import Code, Failure
from reseau.designs import board
from reseau.io.images import write_image
from reseau.optics import OpenCV, Pose, project
from reseau.procedures.calibration_options import CameraOptions
from reseau.procedures.watching import Seen, Watching
from reseau.service.live import LivePage
from reseau_sims.serving import SimulatedCamera, StillScene, VideoCamera, View

from ..capture.fieldrig import FieldRig, Sweeper, enter, write_inputs
from ..drivers.rigs import gige_camera
from ..measure.board_pictures import picture

SIZE = (640, 480)
DESIGN = board("chess", 7, 6, 26.0)


class _Points:
    """A measurement by true positions."""

    def __init__(self, points: ImagePoints) -> None:
        self.points = points


def seen_from(omega: float, phi: float, kappa: float, *, sigma: float = 0.02, away: float = 260.0) -> Any:
    lens = OpenCV.from_parameters({"fx": 700.0, "fy": 700.0, "cx": 319.5, "cy": 239.5})
    turned = Pose.from_angles(omega, phi, kappa, [0.0, 0.0, 0.0])
    middle = np.append(DESIGN.xy.mean(axis=0), 0.0)
    pose = Pose(turned.rotation, middle - turned.matrix.T @ [0.0, 0.0, away])
    xyz = np.column_stack([DESIGN.xy, np.zeros(len(DESIGN.ids))])
    noise = np.random.default_rng(int(1e3 * (omega + phi + kappa + 9))).normal(0, 0.02, (len(xyz), 2))
    return _Points(ImagePoints.with_sigma(DESIGN.ids, project(lens, pose, xyz).xy + noise, sigma))


def test_frames_are_taken_when_still_sharp_and_new() -> None:
    answers: list[Any] = []
    watching = Watching(DESIGN, lambda frame: answers[-1], CameraOptions(free=("fx", "fy", "cx", "cy")))
    frame = Frame(np.zeros((SIZE[1], SIZE[0]), np.uint8), 255.0)

    def look(answer: Any) -> Seen:
        answers.append(answer)
        return watching.on_frame(frame, f"{len(answers)}.png")

    assert "not seen" in look(Failure("no board", Code.NOT_FOUND)).words
    first = seen_from(0.4, 0.0, 0.0)
    assert look(first).words == "hold still"  # nothing to compare with yet
    assert look(first).taken
    assert look(first).words.startswith("seen before")
    second = seen_from(-0.4, 0.2, 1.5)
    assert look(second).words == "hold still"
    assert look(second).taken
    blurred = seen_from(0.0, 0.5, 3.0, sigma=0.2)
    look(blurred)
    assert look(blurred).words.startswith("not sharp")
    third = look(seen_from(0.0, 0.5, 3.0))
    assert third.taken
    assert "do not determine" in third.verdict[0]
    look(seen_from(0.1, -0.4, 4.5))
    last = look(seen_from(0.1, -0.4, 4.5))
    assert last.frames == 4
    assert 0 < last.sigmas["sigma_fx"] < 5
    assert last.verdict[0]
    assert 0.2 < last.covered.mean() < 1


def asked(port: int, path: str, host: str | None = None, method: str = "GET") -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request(method, path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_the_page_answers_this_machine_alone_and_changes_nothing() -> None:
    pixels = np.arange(120, dtype=np.uint8).reshape(10, 12)
    pixels[0, :3] = 255
    frame = Frame(pixels, 255.0)
    seen = Seen(True, "taken", np.array([[3.0, 4.0]]), np.ones((9, 12), dtype=bool), 1, {"sigma_c": 0.01})
    with LivePage("camera: <board>") as page:
        assert asked(page.port, "/frame.jpg")[0] == 404
        page.show(frame, seen, 15)
        assert asked(page.port, "/frame.jpg")[1].startswith(b"\xff\xd8")
        state = json.loads(asked(page.port, "/state.json")[1])
        assert state["points"] == [[3.0, 4.0]]
        assert state["sigmas"] == {"sigma_c": "0.01"}
        assert state["saturated"] == 3 / 120
        assert len(state["histogram"]) == 64
        assert max(state["histogram"]) == 1.0
        assert sum(high > 0 for high in state["histogram"]) == 30  # grey values from 3 to 119, four in each
        jpeg = cv2.imdecode(np.frombuffer(asked(page.port, "/frame.jpg")[1], np.uint8), cv2.IMREAD_COLOR)
        assert jpeg.shape[2] == 3
        assert (jpeg[..., 2].astype(int) - jpeg[..., 0]).max() > 40  # saturated pixels are red
        for path in ("/", "/live.js", "/live.css"):
            status, content = asked(page.port, path)
            assert status == 200
            assert b"http://" not in content.replace(b"http://www.w3.org/2000/svg", b"")
        for host in ("evil.example", f"evil.example:{page.port}", "127.0.0.1", "localhost:1"):
            assert asked(page.port, "/state.json", host)[0] == 403
        assert asked(page.port, "/", f"localhost:{page.port}")[0] == 200
        assert asked(page.port, "/", method="POST")[0] == 501
        assert asked(page.port, "/../live.py")[0] == 404


@pytest.mark.slow
def test_watching_the_simulated_bench_leaves_frames_for_a_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = FieldRig()
    enter(tmp_path, monkeypatch, rig, near=Sweeper("near"), far=Sweeper("far"))
    write_inputs()

    def moved(number: int) -> None:  # two exposures of each pose
        rig.table.stands.update(tilt=30.0, roll=90.0 * ((number - 1) // 2))

    rig.camera.during = moved
    how = ("--pitch-mm", "0.027", "--free", "c,x0,y0,K1", "--count", "3", "--seconds", "200")
    assert run(["watch", "--design", "field.json", "--camera", "camera", "-o", "photos", *how]) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("http://127.0.0.1:")
    assert "3 frames in photos; next: reseau calibrate photos --design field.json" in printed.out
    assert sorted(file.name for file in Path("photos").iterdir()) == ["001.png", "002.png", "003.png"]
    assert run(["watch", "--design", "field.json", "-o", "photos"]) == 2
    assert "photos: is not empty; give a new folder, or resume an earlier session" in capsys.readouterr().err

    def lost(number: int) -> None:  # the camera goes away after the fourth frame
        if len(list(Path("photos").iterdir())) == 4:
            raise ConnectionLost("is away", where="camera")
        rig.table.stands.update(tilt=20.0, roll=45.0)

    rig.camera.during = lost
    more = (*how[:-3], "5", "--seconds", "200", "--resume")
    assert run(["watch", "--design", "field.json", "--camera", "camera", "-o", "photos", *more]) == 1
    printed = capsys.readouterr()
    assert "photos/004.png: " in printed.out
    assert "4 frames in photos; next: reseau calibrate photos" in printed.out
    assert "camera: is away" in printed.err


def test_frames_of_an_earlier_session_are_taken_as_they_are() -> None:
    answers: list[Any] = []
    watching = Watching(DESIGN, lambda frame: answers[-1], CameraOptions(free=("fx", "fy", "cx", "cy")))
    frame = Frame(np.zeros((SIZE[1], SIZE[0]), np.uint8), 255.0)
    for k, answer in enumerate([seen_from(0.4, 0.0, 0.0), Failure("no board", Code.NOT_FOUND)]):
        answers.append(answer)
        declined = watching.resume(frame, f"{k}.png")
        assert (declined is None) == (k == 0)
    assert watching.frames == 1
    answers.append(seen_from(0.4, 0.0, 0.0))
    watching.on_frame(frame, "2.png")
    assert watching.on_frame(frame, "3.png").words.startswith("seen before")


class _Moved:
    """The target before a camera, elsewhere as soon as a frame was taken."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        poses = ((20.0, 10.0), (30.0, 100.0), (35.0, 190.0))
        self.scenes = [StillScene(picture(DESIGN, *pose, 420.0)[0]) for pose in poses]

    def __call__(self, view: View) -> Any:
        return self.scenes[min(len(list(self.folder.glob("*.png"))), len(self.scenes) - 1)](view)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


@pytest.mark.slow
@pytest.mark.parametrize("bus", ["v4l2", "gige"])
def test_frames_are_taken_from_cameras_by_their_drivers(
    bus: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    stack: ExitStack,
) -> None:  # fmt: skip
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    DESIGN.write("board.json")
    body = SimulatedCamera(_Moved(tmp_path / "photos"), 480, 400)
    if bus == "v4l2":
        device = VideoCamera(body)
        monkeypatch.setattr("reseau_drivers.camera.KernelNode", lambda path: device.open())
        camera = "/dev/video0"
    else:
        address, camera = gige_camera(stack, body).address, "eye"
        settings = "width = 480\nheight = 400\nexposure_us = 10000.0\n"
        Path("bench.toml").write_text(
            f'schema = "reseau-bench/1"\nname = "desk"\n[instruments.eye]\ndriver = "aravis"\n'
            f'address = "{address}"\n[instruments.eye.settings]\n{settings}'
        )
    how = ("--design", "board.json", "--camera", camera, "--count", "3", "--seconds", "120")
    assert run(["watch", *how]) == 0
    assert "3 frames in photos; next: reseau calibrate photos" in capsys.readouterr().out
    assert len(list(Path("photos").iterdir())) == 3
    assert body.violations == []


def test_the_width_of_edges_is_shown_with_the_best_so_far() -> None:
    seen = Seen(False, "focus", np.zeros((0, 2)), np.ones((9, 12), dtype=bool), 0)
    shown = []
    with LivePage("camera") as page:
        for sigma in (3.0, 1.0, 2.0, None):
            if sigma is None:
                grey = np.full((60, 60), 90.0)
            else:
                grey = 20 + 200 * ndtr((np.arange(60.0) - 30) / sigma) * np.ones((60, 1))
            page.show(Frame(grey, 255.0), seen, 3)
            shown.append(json.loads(asked(page.port, "/state.json")[1]))
    assert [state["edge_px"] for state in shown[:3]] == pytest.approx([3.0, 1.0, 2.0], rel=0.1)
    assert [state["sharpest_px"] for state in shown] == pytest.approx([3.0, 1.0, 1.0, 1.0], rel=0.1)
    assert shown[3]["edge_px"] is None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("during", ["expose", "measure", "write", "show"])
def test_a_signal_at_any_moment_loses_no_frame_and_ends_with_what_was_taken(
    during: str, number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """The signal comes while the second frame is exposed, measured, written or shown."""
    monkeypatch.chdir(tmp_path)
    DESIGN.write("board.json")
    calls = dict.fromkeys(("expose", "measure", "write", "show"), 0)

    def at(moment: str) -> None:
        calls[moment] += 1
        # Frames are taken from the second on, every second one.
        if moment == during and calls[moment] == {"expose": 4, "measure": 4, "write": 2, "show": 4}[moment]:
            signal.raise_signal(number)

    class Still:
        name = "still"

        def expose(self) -> Any:
            at("expose")
            return SimpleNamespace(frame=Frame(np.full((SIZE[1], SIZE[0]), 90, np.uint8), 255.0))

    class Alone:
        def one(self, *_: object) -> Still:
            return Still()

        def part(self, _: object) -> Alone:
            return self

        def lock(self, _: str) -> nullcontext[None]:
            return nullcontext()

        def __enter__(self) -> Alone:
            return self

        def __exit__(self, *_: object) -> None:
            pass

    def measured(_: object) -> Any:
        at("measure")
        pair = (calls["measure"] - 1) // 2
        return seen_from(0.4 - 0.3 * pair, 0.2 * pair, 1.5 * pair)

    def written(path: Path, pixels: Any) -> None:
        write_image(path, pixels)
        at("write")

    monkeypatch.setattr("reseau.cli.watch._bench", lambda *_: Alone())
    monkeypatch.setattr("reseau.procedures.target_measurement.measurer_of", lambda _: measured)
    monkeypatch.setattr("reseau.procedures.watching.write_image", written)
    shown = LivePage.show
    monkeypatch.setattr(LivePage, "show", lambda *given: (at("show"), shown(*given)))
    before = signal.getsignal(number)
    free = ("--free", "fx,fy,cx,cy", "--no-window")
    assert run(["watch", "--design", "board.json", "--seconds", "60", *free]) == 0
    assert signal.getsignal(number) is before
    said = capsys.readouterr().out.splitlines()
    count = 1 if during == "expose" else 2
    files = sorted(path.name for path in Path("photos").iterdir())
    assert files == ["001.png", "002.png"][:count]
    assert [line.split(":")[0] for line in said if ".png: " in line] == [f"photos/{name}" for name in files]
    few = "in photos, too few to calibrate; --resume continues"
    assert said[-1] == f"{count} frame{'s' * (count > 1)} {few}"
    for name in files:
        assert cv2.imread(f"photos/{name}", cv2.IMREAD_GRAYSCALE).shape == SIZE[::-1]
