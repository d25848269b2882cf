"""Settings of simulated oscilloscopes and the forms of their parameters: ``oscilloscope_settings.toml``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from .program import Parameter, Setting, boolean, choice, numeric, string

_NAMED: Mapping[str, Parameter] = {"boolean": boolean, "string": string, "anything": str.strip}


def _parameter(told: Any) -> Parameter:
    if isinstance(told, list):
        return numeric(*told)
    return _NAMED[told] if told in _NAMED else choice(*told.split("|"))


def _read() -> dict[str, tuple[Setting, ...]]:
    told = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
    parts = {
        name: tuple(Setting(header, _parameter(form), value) for header, (form, value) in part.items())
        for name, part in told.items()
        if name != "of"
    }
    return {
        "" if name == "none" else name: tuple(setting for part in used for setting in parts[part])
        for name, used in told["of"].items()
    }


SETTINGS: Mapping[str, tuple[Setting, ...]] = MappingProxyType(_read())
"""By the transfer of waveforms; those of the screen are among them."""
