"""An archive with a session of a testfield, its calibration, and the history of a configuration."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

from reseau.archive import Archive
from reseau.service import AcceptanceRules, Configurations, Limits
from reseau.sessions import conducting

from ...capture.fieldrig import DESIGN, FieldRig
from ..test_inforce import RULES, camera

START = datetime(2026, 3, 2, 8, 0, tzinfo=UTC)
FIELD_RULES = AcceptanceRules(version=1, image=Limits(warning=0.2, action=0.5), coverage=0.3)
STEPS = (
    ("frontal", {"tilt": 0.0, "roll": 0.0, "camera_roll": 0.0}),
    ("right", {"tilt": 30.0, "roll": 90.0, "camera_roll": 90.0}),
    ("down", {"tilt": 30.0, "roll": 180.0, "camera_roll": 180.0}),
    ("left", {"tilt": 30.0, "roll": 270.0, "camera_roll": 270.0}),
)  # fmt: skip
PARAMETERS = {
    "steps": STEPS, "pitch_mm": 0.027, "free": ("c", "x0", "y0", "K1"), "row_jitter_px": 0.0086, "fill": 0.8
}  # fmt: skip


def temperature(k: int) -> float:
    """Temperature (°C) of the air when calibration `k` of `left` was recorded."""
    return 20.0 + k % 3 + (9.0 if k > 9 else 0.0)


def populate(folder: Path) -> None:
    """Session `monday`, judged for `vidicon`; and 12 calibrations of `left`, of which the last drifts."""
    with Archive.open(folder / "archive", create=True) as archive:
        rig = FieldRig()
        given = dict(PARAMETERS)
        monday = conducting.begin(archive, "monday", "testfield", given, {"design.json": DESIGN.to_json()})
        rig.camera.spoil = lambda number, pixels: pixels * 0 if number == 2 else pixels
        conducting.capture(monday, rig.bench)
        known = Configurations(archive)
        known.define("vidicon", {"camera": "vidicon"})
        known.decide("vidicon", conducting.calibration_of(monday), FIELD_RULES, by="Ada", session="monday")
        known.define("left", {"camera": "DMK 33", "lens": "8 mm"})
        for k in range(12):
            off = 1e-6 * k + 2e-5 * (-1) ** k + (2e-3 if k > 9 else 0.0)
            made = camera(c=8.0 + off, begun=START + timedelta(days=k))
            around = {"mean": temperature(k), "low": 19.0, "high": 31.0, "unit": "°C", "frames": 9}
            made = made.model_copy(update={"provenance": {"environment": {"air.temperature": around}}})
            decision = known.decide("left", made, RULES, by="Ada")
            if decision.outcome == "needs review" and k < 10:
                known.review("left", decision.key, "accepted", by="Ada", comment="as expected")
