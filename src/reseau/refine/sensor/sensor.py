"""From the frames of a series to the calibration of the sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...adjust import Failure
from ...calibration import Calibration, Covariance, Quantity
from ...errors import EstimationError
from .correction import SensorCorrection
from .edge import EdgeSpread
from .fields import Fields, estimate_fields
from .series import SensorSeries
from .transfer import Linearity, PhotonTransfer, curve_of, fit_linearity, fit_transfer

__all__ = ["SensorResult", "calibrate_sensor"]


@dataclass(frozen=True, eq=False)
class SensorResult:
    """What was found of a sensor; truthy.

    Parameters
    ----------
    fields : Fields
        Of each pixel.
    transfer : PhotonTransfer
        Gain, noise, full well.
    linearity : Linearity or Failure
        The answer to light; falsy with too few exposures, and then taken as straight.
    full_scale : float
        Of the frames.
    exposure_us : float
        The brightest unsaturated one.
    edge : EdgeSpread, optional
        Sharpness.
    """

    fields: Fields
    transfer: PhotonTransfer
    linearity: Linearity | Failure
    full_scale: float
    exposure_us: float
    edge: EdgeSpread | None = None

    @property
    def dsnu(self) -> float:
        """Standard deviation of the bias over the good pixels (grey values)."""
        return float(self.fields.bias[~self.fields.defects].std(dtype=np.float64))

    @property
    def prnu(self) -> float:
        """Standard deviation of the response over the good pixels, uneven light included."""
        return float(self.fields.response[~self.fields.defects].std(dtype=np.float64))

    @property
    def correction(self) -> SensorCorrection:
        """What is applied to frames."""
        b2, b3 = 0.0, 0.0
        if isinstance(self.linearity, Linearity):
            b2, b3 = self.linearity.fit["b2"], self.linearity.fit["b3"]
        return SensorCorrection(self.fields, b2, b3, self.full_scale, self.exposure_us)

    def quantities(self) -> dict[str, Quantity]:
        """What was estimated, by name."""
        fit = self.transfer.fit
        found = {
            "gain": Quantity(value=fit["gain"], sigma=fit.sigma_of("gain"), unit="e-/DN"),
            "read_noise": Quantity(value=abs(fit["read_noise"]), sigma=fit.sigma_of("read_noise"), unit="DN"),
        }
        if (well := self.transfer.full_well) is not None:
            found["full_well"] = Quantity(value=well[0], sigma=well[1], unit="e-")
        if isinstance(self.linearity, Linearity):
            for name in ("b2", "b3"):
                fit = self.linearity.fit
                found[name] = Quantity(value=fit[name], sigma=fit.sigma_of(name), unit="1")
        if self.edge is not None:
            psf = self.edge.fit
            found["psf"] = Quantity(value=abs(psf["psf"]), sigma=psf.sigma_of("psf"), unit="px")
            half, sigma = self.edge.mtf50
            found["mtf50"] = Quantity(value=half, sigma=sigma, unit="1/px")
        return found

    def calibration(self, name: str, provenance: Mapping[str, Any], times: Mapping[str, str]) -> Calibration:
        """As a ``reseau-calibration/1`` of the kind camera, whose model is a sensor."""
        fit = self.transfer.fit
        names: tuple[str, ...] = ("gain", "read_noise")
        matrix = np.zeros((4, 4))
        matrix[:2, :2] = fit.covariance_of(*names)
        if isinstance(self.linearity, Linearity):
            names += ("b2", "b3")
            matrix[2:, 2:] = self.linearity.fit.covariance_of("b2", "b3")
        size = len(names)
        rows = tuple(tuple(row) for row in matrix[:size, :size].tolist())
        test = fit.global_test()
        return Calibration(
            kind="camera",
            name=name,
            model=self.correction.to_model(),
            parameters=self.quantities(),
            covariance=Covariance(names=names, matrix=rows),
            sigma0=fit.sigma0,
            redundancy=fit.redundancy,
            tests=({"name": "photon transfer", "passed": test.passed, "statistic": test.statistic},),
            validity=self.validity(),
            provenance=dict(provenance),
            times=dict(times),
        )

    def validity(self) -> dict[str, Any]:
        """Where the calibration holds, and how uneven the sensor is."""
        height, width = self.fields.bias.shape
        straight = isinstance(self.linearity, Linearity)
        return {
            "size": [width, height],
            "full_scale": self.full_scale,
            "exposure_us": self.exposure_us,
            "dsnu": self.dsnu,
            "prnu": self.prnu,
            "defects": int(self.fields.defects.sum()),
            "nonlinearity": self.linearity.worst if isinstance(self.linearity, Linearity) else None,
            "linearity": "fitted" if straight else getattr(self.linearity, "reason", ""),
            "saturated": self.transfer.curve.plateau is not None,
        }


def calibrate_sensor(series: SensorSeries, edge: EdgeSpread | None = None) -> SensorResult:
    """Calibrate a sensor.

    Parameters
    ----------
    series : SensorSeries
        Frames in the dark and of even light.
    edge : EdgeSpread, optional
        Sharpness, measured before.

    Raises
    ------
    EstimationError
        When gain and noise cannot be had.
    """
    fields = estimate_fields(series)
    curve = curve_of(series, fields)
    linearity = fit_linearity(curve, series.full_scale)
    transfer = fit_transfer(curve, linearity if isinstance(linearity, Linearity) else None)
    if isinstance(transfer, Failure):
        raise EstimationError(transfer.reason, where="photon transfer")
    brightest = curve.exposure_us[curve.bright & curve.usable].max()
    return SensorResult(fields, transfer, linearity, series.full_scale, float(brightest), edge)
