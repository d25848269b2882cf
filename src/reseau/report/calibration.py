"""Report of a calibration that was read from a file: verdict, errors over the image, parameters."""

from __future__ import annotations

from markupsafe import Markup

from ..calibration import Calibration
from ..core.figures import drawing, to_svg
from .template import rendered

__all__ = ["calibration_report"]


def calibration_report(calibration: Calibration) -> str:
    """Return the report of a calibration as an HTML page.

    The report of the run that made it has photographs and residuals, too; they are not in the calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.

    Examples
    --------
    >>> from reseau.calibration.document import Covariance
    >>> pinhole = Calibration(
    ...     kind="camera", name="pinhole", sigma0=None, redundancy=0,
    ...     model={"model": "brown", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01]}, parameters={},
    ...     covariance=Covariance(names=(), matrix=()),
    ... )
    >>> "This calibration has no verdict" in calibration_report(pinhole)
    True
    """
    with drawing():
        figure = calibration.plot().figure
        assert figure is not None
        picture = to_svg(figure.get_figure(root=True))
    verdict = calibration.assessment
    sigma0 = [] if calibration.sigma0 is None else [(f"{calibration.sigma0:.3f}", "", "sigma0")]
    return rendered(
        "calibration.html.j2",
        title=f"Calibration {calibration.name}",
        kind=calibration.kind.capitalize(),
        summary=[(str(len(calibration.parameters)), "", "parameters"), *sigma0],
        lines=[] if verdict is None else list(verdict.lines),
        map=Markup(picture),
        parameters=calibration.printed(),
        **({"provenance": calibration.provenance} if calibration.provenance else {}),
    )
