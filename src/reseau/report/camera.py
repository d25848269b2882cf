"""The section on a camera calibrated with a testfield, compared with its true parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from ..bundle import Result
from ..bundle.diagnostics.fields import camera_mapping
from .bundle_figures import distortion_figure, network_figure
from .tables import Row, symbol


def camera_section(result: Result, images: int, true: Mapping[str, float]) -> Row:
    """Return the content of the section's template.

    Parameters
    ----------
    result : Result
        Result of the bundle adjustment of one camera.
    images : int
        Number of frames.
    true : mapping of str to float
        True parameters of the simulator.
    """
    names, _, values = result.camera_columns(0)
    sigma = np.sqrt(np.diag(result.camera_covariance(0)))
    rows = [
        (symbol(name), *_alike(value, s, true[name]), f"{(value - true[name]) / s:+.2f}")
        for name, value, s in zip(names, values, sigma, strict=True)
    ]
    errors = np.array([float(row[-1]) for row in rows])
    profile = distortion_figure(camera_mapping(result, 0))
    return {
        "images": images,
        "points": len(result.network.xy),
        "sigma0": f"{result.sigma0:.3f}",
        "redundancy": result.redundancy,
        "rows": rows,
        "rms": f"{np.sqrt(np.mean(errors**2)):.2f}",
        "network": Markup(network_figure(result)),
        "distortion": None if profile is None else Markup(profile[0]),
        "distortion_of": "" if profile is None else profile[1],
    }


def _alike(*values: float) -> tuple[str, ...]:
    """Estimate, sigma and truth with two digits of the sigma."""
    decimals = max(0, 1 - int(np.floor(np.log10(values[1]))))
    return tuple(f"{value:.{decimals}f}" for value in values)
