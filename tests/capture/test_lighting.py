"""Exposure and gain by rule: reached where the light allows, told where it does not."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from reseau.capture.lighting import LightRule, level_of, steer
from reseau.core.data import Frame
from reseau.core.errors import RefusedError, UsageError
from reseau.instruments import Settings, quantity


@dataclass(frozen=True)
class Light(Settings):
    """Of a camera with a gain in dB."""

    exposure_us: float = quantity(1000.0, "µs", 10.0, 1e6)
    gain: float = quantity(0.0, "dB", 0.0, 24.0)


class Eye:
    """A camera before a scene with some grey values per microsecond, and a black level."""

    name = "eye"

    def __init__(self, light: float, black: float = 0.0, longest: float = 1e6) -> None:
        self.light, self.black, self.longest = light, black, longest
        self.settings = Light()
        self.frames = 0

    def configure(self, changes: dict[str, float]) -> None:
        if changes["exposure_us"] > self.longest:
            raise RefusedError(f"exposure_us {changes['exposure_us']:g} is outside 10…{self.longest:g}")
        self.settings = self.settings.changed(changes)

    def expose(self) -> Any:
        self.frames += 1
        exposure, gain = self.settings.exposure_us, self.settings.gain
        scene = np.linspace(0.2, 1.0, 10_000).reshape(100, 100)
        grey = self.black + scene * self.light * exposure * 10 ** (gain / 20)
        pixels = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        return SimpleNamespace(frame=Frame(pixels, 255.0), exposure_us=exposure, gain=gain)


@pytest.mark.parametrize("light", [0.0005, 0.02, 0.2, 3.0, 20.0])
@pytest.mark.parametrize("black", [0.0, 12.0])
def test_the_percentile_reaches_its_share_of_full_scale(light: float, black: float) -> None:
    camera: Any = Eye(light, black)
    rule = LightRule(longest_us=1e6)
    steered = steer(camera, rule)
    assert steered
    assert abs(steered.level / rule.share - 1) <= rule.within
    assert level_of(camera.expose().frame, rule.percentile) == pytest.approx(steered.level, abs=0.01)
    assert steered.frames == camera.frames - 1 <= 8
    assert steered.gain == 0


def test_the_gain_is_raised_where_the_exposure_may_not_be_longer() -> None:
    camera: Any = Eye(0.02)
    steered = steer(camera, LightRule(longest_us=5000.0))
    assert steered
    assert steered.exposure_us == 5000.0
    assert steered.gain == pytest.approx(20 * np.log10(0.8 * 255 / 0.02 / 5000), abs=0.5)


def test_gain_is_lowered_before_the_exposure() -> None:
    camera: Any = Eye(0.2)
    camera.configure({"exposure_us": 1000.0, "gain": 6.0})
    steered = steer(camera, LightRule(longest_us=50_000.0))
    assert steered
    assert steered.gain == 0.0


def test_too_little_light_is_reported() -> None:
    camera: Any = Eye(0.0001)
    steered = steer(camera, LightRule(longest_us=5000.0))
    assert not steered
    assert steered.why.startswith("the rule is not met: ")
    assert steered.why.endswith("at 5 ms and 12 dB: add light")


def test_a_camera_that_refuses_longer_exposures_is_taken_as_far_as_it_goes() -> None:
    camera: Any = Eye(0.02, longest=2000.0)
    steered = steer(camera, LightRule())
    assert not steered
    assert "is outside 10…2000" in steered.why or "add light" in steered.why
    assert camera.settings.exposure_us > 1500


def test_an_impossible_rule_is_refused() -> None:
    with pytest.raises(UsageError, match=r"percentile 101 at 0\.8"):
        LightRule(percentile=101.0)
