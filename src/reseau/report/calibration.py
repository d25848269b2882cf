"""Report of a calibration that was read from a file: verdict, errors over the image, parameters."""

from __future__ import annotations

from collections.abc import Mapping

from markupsafe import Markup

from ..calibration import Calibration
from ..core.figures import drawing, to_svg
from .template import rendered


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
    model: Mapping[str, object] = calibration.model
    images = calibration.validity.get("images")
    camera = f"{model.get('model')}, {model.get('width')} × {model.get('height')} px"
    facts = [camera] if calibration.kind == "camera" else []
    facts += [f"{images} photographs"] if images else []
    facts += filter(None, [calibration.provenance.get("software")])
    sigma0 = [] if calibration.sigma0 is None else [(f"{calibration.sigma0:.3f}", "", "sigma0")]
    return rendered(
        "calibration.html.j2",
        title=f"Calibration {calibration.name}",
        kind=calibration.kind.capitalize(),
        summary=[(str(len(calibration.parameters)), "", "parameters"), *sigma0],
        facts=facts,
        lines=[] if verdict is None else list(verdict.lines or (verdict.short,)),
        use="" if verdict is None else verdict.use.value,
        map=Markup(picture),
        parameters=calibration.printed(),
        **({"provenance": calibration.provenance} if calibration.provenance else {}),
    )
