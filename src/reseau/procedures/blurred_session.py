"""Meid's procedure as frames arrive: ordinary coordinates of each, and the whole network at the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..archive import Verdict
from ..bundle import Network
from ..core.data import Frame
from ..core.environment import Surroundings
from ..core.errors import EstimationError
from ..core.failure import Failure
from ..core.provenance import Provenance
from ..exchange.lenses import Lens
from ..io.network import Network1
from ..io.targets import SpaceTargets
from ..measure.ordinary import ordinary_coordinates
from .blurred_files import BlurredImaging, network_documents
from .blurred_network import BlurredNetwork, NetworkOptions, measure_blurred_network
from .testfield import P, Place

_FEWEST = 6
"""Targets that must stand out in a usable frame: twice what its orientation needs."""


class BlurredProcedure:
    """The procedure for the frames of a session.

    Parameters
    ----------
    document : Network1
        The network: its images are named as the poses of the session, with approximate coordinates.
    network : Network
        The same, read.
    targets : SpaceTargets
        Shape, size and direction of the targets.
    lens : Lens
        Of all cameras.
    options : NetworkOptions
    name : str
        Name of the session.
    parameters : mapping
        Parameters that influence the result, for the provenance.
    inputs : mapping
        SHA-256 of the input files by name, for the provenance.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> from reseau.bundle.network.settings import network_document
    >>> from reseau.designs import space_frame
    >>> from reseau.optics.lenses import AIR, Prescription, glass, in_order
    >>> rows = [(0.02, 5.0, glass("N-BK7")), (-0.02, 46.5, AIR)]
    >>> lens, network = Lens(Prescription(in_order(rows), stop=0, stop_radius=5.0)), example_network()
    >>> procedure = BlurredProcedure(
    ...     network_document(network), network, space_frame(), lens, NetworkOptions(), name="monday")
    >>> procedure.progress()
    {}
    """

    def __init__(
        self,
        document: Network1,
        network: Network,
        targets: SpaceTargets,
        lens: Lens,
        options: NetworkOptions,
        *,
        name: str,
        parameters: Mapping[str, Any] | None = None,
        inputs: Mapping[str, str] | None = None,
    ) -> None:
        self.document, self.network, self.targets, self.lens = document, network, targets, lens
        self.options, self.name = options, name
        self._parameters, self._inputs = dict(parameters or {}), dict(inputs or {})
        self._surroundings = Surroundings()
        self._frames: dict[str, Frame] = {}
        self._found: tuple[int, BlurredNetwork | Failure] | None = None

    def on_frame(self, frame: Frame, step: Place) -> Verdict:
        """Look for the targets of the image that the pose names."""
        network = self.network
        if step.name not in network.images:
            return Verdict(False, f"{step.name} is not an image of the network")
        camera = network.cameras[network.camera_of[network.images.index(step.name)]]
        if (frame.width, frame.height) != (camera.width, camera.height):
            size = f"{frame.width}×{frame.height} pixels, not {camera.width}×{camera.height}"
            return Verdict(False, f"has {size} as {camera.label}")
        rows = np.flatnonzero(network.image_of == network.images.index(step.name))
        found = ordinary_coordinates(frame, network.xy[rows], polarity=self.targets.polarity)
        count = int(np.isfinite(found).all(axis=1).sum())
        if count < _FEWEST:
            return Verdict(False, f"{count} of {len(rows)} targets stand out near their predicted places")
        self._frames[step.name], self._inputs[step.name] = frame, frame.sha256
        self._surroundings.add(step.name, step)
        return Verdict(True, facts={"points": count})

    def progress(self) -> dict[str, float]:
        """Nothing: the network is adjusted when all images are there."""
        return {}

    def next_pose(self, candidates: Sequence[P], wanted: str) -> tuple[P, float | None] | None:
        """Return the first pose that has not been taken, without a prediction."""
        left = [each for each in candidates if each.name not in self._frames]
        return (left[0], None) if left else None

    @property
    def provenance(self) -> Provenance:
        """Inputs and parameters of the result."""
        return Provenance(self._inputs, self._parameters, environment=self._surroundings.summary())

    def measured(self) -> BlurredNetwork | Failure:
        """Return the network from the frames so far; images without one are left out."""
        if self._found is None or self._found[0] != len(self._frames):
            network = self.network
            taken = np.array([name in self._frames for name in network.images])
            network = network.select(taken[network.image_of])
            cameras = BlurredImaging(self.lens).cameras(network)
            found = measure_blurred_network(network, self._frames, self.targets, cameras, self.options)
            self._found = len(self._frames), found
        return self._found[1]

    def finish(self) -> dict[str, str]:
        """Return every round, the final result and the final network.

        Raises
        ------
        EstimationError
            If the network cannot be adjusted, or no target measured.
        """
        found = self.measured()
        if isinstance(found, Failure):
            raise EstimationError(found.reason, where=self.name)
        return network_documents(found, self.document, self.provenance)
