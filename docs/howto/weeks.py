"""An archive of 75 weekly calibrations, and the temperature at each; it becomes warmer by 4 K after the 35th.

python weeks.py    # archive, runs.csv
"""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from reseau import Calibration
from reseau.archive import Archive
from reseau.service import AcceptanceRules, Configurations, Limits

TRUE = {"c": 8.0, "x0": 0.02, "y0": -0.01, "K1": 1e-3}
SIGMA = {"c": 2e-4, "x0": 1e-4, "y0": 1e-4, "K1": 2e-6}
BY_KELVIN = {"c": 1e-3, "x0": -5e-4}
RULES = AcceptanceRules(version=1, image=Limits(warning=0.5, action=2.0))
FIRST = datetime(2025, 3, 3, 8, tzinfo=UTC)


def calibrated(temperature, rng):
    """A calibration at a temperature, °C."""
    values = {name: value + BY_KELVIN.get(name, 0) * (temperature - 20) for name, value in TRUE.items()}
    return Calibration.from_content(
        {
            "schema": "reseau-calibration/1", "kind": "camera", "name": "left",
            "sigma0": 1.0, "redundancy": 400,
            "model": {"model": "brown", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01]},
            "parameters": {
                name: {"value": value + SIGMA[name] * rng.normal(), "sigma": SIGMA[name],
                       "unit": "mm^-2" if name == "K1" else "mm"}
                for name, value in values.items()
            },
            "covariance": {"names": list(SIGMA), "matrix": np.diag(np.square(list(SIGMA.values()))).tolist()},
            "validity": {"extent": [10.0, 10.0, 630.0, 470.0], "unit": "px"},
        },
        where="drawn",
    )  # fmt: skip


def main():
    """Write the archive and the table."""
    rng, rows = np.random.default_rng(1), ["calibration,temperature [°C]"]
    with Archive.open("archive", create=True) as archive:
        known = Configurations(archive)
        known.define("left", {"camera": "DMK 33", "lens": "8 mm"})
        for week in range(75):
            temperature = 20.5 + 4 * (week >= 35) + rng.uniform(-0.6, 0.6)
            made = known.decide(
                "left", calibrated(temperature, rng), RULES, since=FIRST + timedelta(weeks=week)
            )
            if made.outcome == "needs review":
                known.review("left", made.key, "accepted", comment="first")
            rows.append(f"{made.key},{temperature:.1f}")
    Path("runs.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
