"""Display of an acquisition on a terminal, also a narrow one: pose, frames, precision, remaining time."""

import io
import re

import pytest

from reseau.cli.acquisition import Display


class Terminal(io.StringIO):
    """Text sent to the terminal."""

    def isatty(self) -> bool:
        return True


def at_terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Of 80 columns, for both streams."""
    made = Terminal()
    for name, value in {"COLUMNS": "80", "TERM": "xterm", "NO_COLOR": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("sys.stderr", made)
    monkeypatch.setattr("sys.stdout", made)
    return made


def shown(terminal: Terminal) -> list[str]:
    """Its lines, without control sequences."""
    return re.sub(r"\x1b\[[0-9?;]*[A-Za-z]", "", terminal.getvalue()).replace("\r", "\n").splitlines()


def frame(step: str, **more: object) -> dict[str, object]:
    return {"step": step, "take": 0, "ok": True, "why": "", "there": False} | more


def test_the_bar_shows_pose_frames_precision_and_remaining_time(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = at_terminal(monkeypatch)
    with Display(False, 3, units={"c": "mm"}) as display:
        for k in range(2):
            display.watch("frame", frame(f"tilt {k}", points=300))
        display.watch("precision", {"step": "tilt 1", "sigma_c": 0.0123, "sigma_x0": 0.5, "sigma_K1": 1e-5})
        display.watch("outlook", {"step": "tilt 2 roll 180 camera_roll 180", "sigma_c": 0.01})
    lines = shown(terminal)
    assert any(re.search(r"2/3 +[0-9-]+:.* sigma_c 0\.012 mm · 2 frames · tilt 2 ro", line) for line in lines)
    # Above it stays what happened.
    assert "    next tilt 2 roll 180 camera_roll 180: sigma_c 0.01 mm predicted" in [
        line.rstrip() for line in lines
    ]


def test_a_bad_frame_is_reported_above_the_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = at_terminal(monkeypatch)
    with Display(False, 3) as display:
        display.watch("frame", frame("tilt 0", ok=False, why="the table moved during the exposure"))
    assert "0/3 tilt 0: the table moved during the exposure" in [line.rstrip() for line in shown(terminal)]


def test_nothing_is_drawn_during_a_question(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = at_terminal(monkeypatch)
    with Display(False, 3) as display:

        def ask(what: str) -> str:
            terminal.truncate(0)
            terminal.seek(0)
            display.watch("frame", frame("tilt 0"))
            assert [line.rstrip() for line in shown(terminal)] == ["1/3 tilt 0: good, 0 s left"]
            return f"{what}!"

        assert display.aside(ask)("yes") == "yes!"
        display.watch("frame", frame("tilt 1"))
    assert "2/3 tilt 1: good, 0 s left" in [line.rstrip() for line in shown(terminal)]


def test_remaining_time_depends_only_on_frames_taken_now(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([0.0, *[1.0] * 8, 11.0])
    monkeypatch.setattr("reseau.cli.acquisition.time.monotonic", lambda: next(clock))
    display = Display(False, 12)
    for k in range(8):
        display.watch("frame", frame(str(k), there=True))
    display.watch("frame", frame("8"))
    assert capsys.readouterr().out.splitlines()[-2:] == ["8/12 7: good", "9/12 8: good, 30 s left"]


def test_a_missing_prediction_is_also_reported(capsys: pytest.CaptureFixture[str]) -> None:
    display = Display(False, 3, units={"c": "mm"})
    display.watch("outlook", {"step": "tilt 2", "sigma_c": 0.01})
    display.watch("outlook", {"step": "tilt 2", "why": "poses are 9° off"})
    display.watch("next", {"step": "tilt 2", "sigma_c": None})
    message = capsys.readouterr().out.splitlines()
    assert message[:2] == [
        "    next tilt 2: sigma_c 0.01 mm predicted",
        "    next tilt 2: no prediction (poses are 9° off)",
    ]
    assert message[2] == "next pose tilt 2"


def test_sections_are_counted_in_a_session_of_sections(capsys: pytest.CaptureFixture[str]) -> None:
    for sections in (True, False):
        display = Display(False, 2, sections)
        for kind in ("scan", "screen"):
            display.watch("picture", {"step": "PHOTO II", "kind": kind, "there": False})
    message = capsys.readouterr().out.splitlines()
    assert message == ["1/2 PHOTO II: scan", "PHOTO II: screen", "PHOTO II: scan", "PHOTO II: screen"]
