"""The published networks, read once."""

from __future__ import annotations

from collections.abc import Callable
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
