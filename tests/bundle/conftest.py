"""The published networks, read once; networks of any size in compiled loops."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from reseau.bundle import Network
from reseau.io.network import Network1


@pytest.fixture(scope="session")
def published(reference_data: Callable[[str], Path]) -> Callable[[str], Network]:
    """A network of the reference data."""

    def read(name: str) -> Network:
        return Network.from_document(Network1.read(reference_data(f"networks/{name}.network.json")))

    return read


@pytest.fixture(autouse=True, scope="module")
def in_loops() -> Iterator[None]:
    """Compute small networks in compiled loops, too, as large ones are."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("reseau.bundle.network.network._FEW", 0)
        yield
