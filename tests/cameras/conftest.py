"""The models of these tests are registered while they run."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from reseau.cli import run
from reseau.optics.cameras import registry
from reseau.optics.cameras.registry import register_camera

from . import division, equidistant


@pytest.fixture(scope="package", autouse=True)
def _third_models() -> Iterator[None]:
    for model in (equidistant.MODEL, division.MODEL):
        register_camera(model)
    yield
    for model in (equidistant.MODEL, division.MODEL):
        del registry._CAMERAS[model.name]


@pytest.fixture
def reseau(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run a command in process: its exit status, standard output and standard error."""

    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = run([str(argument) for argument in arguments])
        written = capsys.readouterr()
        return status, written.out, written.err

    return call
