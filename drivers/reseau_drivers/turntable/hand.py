"""A table that is moved by hand: a person sets an axis, and its scale or a marker in a picture tells where.

A reading typed in is that of the scale, whose zero is the reference: the axis needs no homing. A marker of
the ArUco kind (S. Garrido-Jurado et al., Pattern Recognition 47, 2014) is fixed to the table and seen by a
camera of the bench. `angle`: the axis turns the marker in the image; its direction is the position. `shift`:
the axis moves it in the image, and the length of its side gives the scale.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.errors import InstrumentError, SettingError, StateError
from reseau.instruments import Camera, Deadline, Identity, Instrument

from .reference import References, Reported
from .table import AxisPlan, Table

_TRIES = 3
"""How often a person is asked to set an axis that is not where it should be."""


class Person(Protocol):
    """Who moves the table; see :class:`reseau.instruments.RemoteOperator`."""

    @property
    def address(self) -> str:
        """Where the person is asked."""

    def __call__(self, request: str) -> None:
        """Return when the request is carried out."""

    def read(self, request: str, unit: str, seconds: float | None = None) -> float:
        """Return the number that the person reads."""


@dataclass(frozen=True)
class Marker:
    """A marker on the table, and what its place in the image means.

    Parameters
    ----------
    id : int
        Number of the marker.
    reads : {"angle", "shift"}
        Whether the axis turns the marker in the image, or moves it.
    zero : float
        What is measured where the axis stands at 0: direction of the upper side (degrees, counter-clockwise),
        or distance along `direction` (mm).
    sign : {1, -1}
        Whether the position increases with what is measured.
    side_mm : float
        Length of a side, for a shift.
    direction : float
        Direction in the image in which a shift is measured (degrees counter-clockwise from the right).
    dictionary : str
        Dictionary of the markers, as OpenCV names it.

    Raises
    ------
    SettingError
        If a field is out of range, or the dictionary does not exist.

    Examples
    --------
    >>> Marker(7).reads
    'angle'
    """

    id: int
    reads: Literal["angle", "shift"] = "angle"
    zero: float = 0.0
    sign: int = 1
    side_mm: float = 0.0
    direction: float = 0.0
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        right = self.reads in ("angle", "shift") and self.sign in (1, -1)
        if not right or (self.reads == "shift" and not self.side_mm > 0):
            what = "reads is angle or shift, sign 1 or -1; a shift needs side_mm"
            raise SettingError(what, where=f"marker {self.id}")
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise SettingError(f"{self.dictionary} does not exist", where=f"marker {self.id}")


def marker_position(pixels: NDArray[Any], marker: Marker) -> float:
    """Return the position of an axis from a picture of its marker, in degrees or millimetres.

    Parameters
    ----------
    pixels : ndarray (height, width)
        Grey values.
    marker : Marker
        The marker; angles are in [0, 360).

    Raises
    ------
    StateError
        If the marker is not in the picture, or more than once.

    Examples
    --------
    >>> known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    >>> drawn = np.pad(cv2.aruco.generateImageMarker(known, 7, 120), 40, constant_values=255)
    >>> abs(marker_position(np.rot90(drawn), Marker(7)) - 90.0) < 0.1
    True
    """
    grey = np.asarray(pixels, dtype=np.float64)
    high = max(float(grey.max()), 1.0)
    picture = np.clip(255.0 * grey / high, 0, 255).astype(np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
    corners, ids, _ = cv2.aruco.ArucoDetector(known, parameters).detectMarkers(picture)
    numbers = [] if ids is None else ids.ravel().tolist()
    there = [c.reshape(4, 2) for c, number in zip(corners, numbers, strict=True) if number == marker.id]
    if len(there) != 1:
        count = "does not see" if not there else f"sees {len(there)} times"
        raise StateError(f"{count} marker {marker.id}", do="free the view of it, and light it")
    # Corners are in order around the marker, from the upper left.
    box = there[0].astype(np.float64)
    along = (box[1] - box[0] + box[2] - box[3]) / 2
    if marker.reads == "angle":
        turned = marker.sign * (math.degrees(math.atan2(-along[1], along[0])) - marker.zero)
        return turned % 360.0
    side = float(np.linalg.norm(np.roll(box, -1, axis=0) - box, axis=1).mean())
    way = math.radians(marker.direction)
    place = box.mean(axis=0) @ np.array([math.cos(way), -math.sin(way)])
    return marker.sign * (float(place) * marker.side_mm / side - marker.zero)


class ByHand:
    """The person as a controller of axes.

    Parameters
    ----------
    person : Person
        Who moves the axes, and reads their scales.
    markers : mapping of str to Marker
        Markers of axes that a camera reads.

    Examples
    --------
    >>> from reseau.instruments import TerminalOperator
    >>> ByHand(TerminalOperator(), {}).checked
    True
    """

    checked = True

    def __init__(self, person: Person, markers: Mapping[str, Marker]) -> None:
        self._person, self._markers = person, dict(markers)
        self.camera: Camera | None = None
        self._stands: dict[str, float] = {}
        self.references = References()

    def open(self, deadline: Deadline) -> None:
        """Do nothing: each request makes its own connection."""

    def close(self) -> None:
        """End a question that waits."""
        leave = getattr(self._person, "leave", None)
        if leave is not None:
            leave()

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Return where the person is asked."""
        return Identity("moved by hand", self._person.address)

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Do nothing: a person is as fast as a person is."""

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Read where the axis stands: its scale is its reference."""
        self._stands[plan.name] = self._read(plan, f"read the scale of {plan.name}", deadline)

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Have the axis set, again if it is not where it should be."""
        request = f"set {plan.name} to {position:g} {plan.unit}"
        for attempt in range(_TRIES):
            stands = self._set(plan, request, deadline)
            self._stands[plan.name] = stands
            if abs(stands - position) <= plan.tolerance or deadline.expired or attempt == _TRIES - 1:
                return
            request = (
                f"set {plan.name} to {position:g} {plan.unit} within {plan.tolerance:g}: "
                f"it stands at {stands:g} {plan.unit}"
            )

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Do nothing: nothing moves by itself."""

    def state(self, plan: AxisPlan, deadline: Deadline) -> Reported:
        """Return where the axis was last read to stand; a marker is looked at each time."""
        if plan.name not in self._stands or plan.name in self._markers:
            self.begin_home(plan, deadline)
        return Reported(self._stands[plan.name], moving=False, referenced=True)

    def _set(self, plan: AxisPlan, request: str, deadline: Deadline) -> float:
        if plan.name in self._markers:
            with _about_the_table():
                self._person(request)
            return self._seen(plan, deadline)
        return self._asked(plan, f"{request}, and read its scale", deadline)

    def _read(self, plan: AxisPlan, request: str, deadline: Deadline) -> float:
        if plan.name in self._markers:
            return self._seen(plan, deadline)
        return self._asked(plan, request, deadline)

    def _asked(self, plan: AxisPlan, request: str, deadline: Deadline) -> float:
        with _about_the_table():
            return self._person.read(request, plan.unit, deadline.left) / plan.per_unit

    def _seen(self, plan: AxisPlan, deadline: Deadline) -> float:
        if self.camera is None:
            raise StateError("has no camera that sees its marker", do="name one: camera = …")
        frame = self.camera.expose(max(0.1, deadline.at_most(10.0))).frame
        place = marker_position(frame.pixels, self._markers[plan.name])
        # An angle is known up to whole turns.
        if self._markers[plan.name].reads == "angle" and place > plan.high:
            place -= 360.0
        return place


@contextmanager
def _about_the_table() -> Iterator[None]:
    """Errors name the table, not the person."""
    try:
        yield
    except InstrumentError as error:
        raise type(error)(error.what, do=error.do, command=error.command) from None


class HandTable(Table):
    """Driver of a table that is moved by hand.

    Parameters
    ----------
    name : str
        Name on the bench.
    controller : ByHand
        The person.
    plans : mapping of str to AxisPlan
        Axes by name.
    camera : str
        Camera of the bench that sees the markers; empty: the only one.
    **options
        Further arguments of :class:`Table`.

    Examples
    --------
    >>> from reseau.instruments import TerminalOperator
    >>> HandTable("table", ByHand(TerminalOperator(), {}), {"tilt": AxisPlan()}).uses
    ()
    """

    MOVE_S = 900.0

    def __init__(
        self,
        name: str,
        controller: ByHand,
        plans: Mapping[str, AxisPlan],
        *,
        camera: str = "",
        **options: Any,
    ) -> None:
        super().__init__(name, controller, plans, **{"seconds": self.MOVE_S, **options})
        self._person, self._camera = controller, camera

    @property
    def uses(self) -> tuple[str, ...]:
        """Other instruments that it needs."""
        return super().uses + ((self._camera,) if self._camera else ())

    def combine(self, instruments: Mapping[str, Instrument]) -> None:
        """Find the camera that sees the markers, and join zones.

        Raises
        ------
        SettingError
            If there is no such camera.
        """
        super().combine(instruments)
        if not self._camera:
            return
        found = instruments.get(self._camera)
        if not isinstance(found, Camera):
            raise SettingError(f"{self._camera!r} is no camera of this bench", where=self.name)
        self._person.camera = found

    def _test(self, deadline: Deadline) -> dict[str, str]:
        return dict.fromkeys(self.plans, "moved by hand")
