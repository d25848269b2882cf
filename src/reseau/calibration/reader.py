"""The one reader of calibrations, of every kind and every schema that holds one."""

from __future__ import annotations

import json
from pathlib import Path

from ..core.errors import FormatError
from ..io import FiducialOrientation, FrameOrientation
from ..io.document import read_text
from .document import Calibration
from .fiducials import calibration_of_fiducials
from .film import calibration_of_frame


def read_calibration(path: Path | str) -> Calibration:
    """Read a calibration of any kind.

    Parameters
    ----------
    path : path
        ``reseau-calibration/1`` of any kind and age, or the orientation of a film frame
        (``reseau-orientation/1``) or of a photograph with fiducial marks (``reseau-fiducials/1``).

    Returns
    -------
    Calibration
        Its :meth:`~Calibration.mapping` is applied to points, images or frames.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is no calibration.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.calibration.document import Covariance, Quantity
    >>> camera = Calibration(
    ...     kind="camera", name="ideal", sigma0=None, redundancy=0,
    ...     model={"model": "opencv", "width": 640, "height": 480, "pitch_mm": [1.0, 1.0]},
    ...     parameters={"fx": Quantity(value=800.0, sigma=0.1, unit="px"),
    ...                 "fy": Quantity(value=800.0, sigma=0.0, unit="px")},
    ...     covariance=Covariance(names=("fx",), matrix=((0.01,),)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     camera.write(Path(folder) / "camera.json")
    ...     again = read_calibration(Path(folder) / "camera.json")
    >>> again == camera, again.mapping().names
    (True, ('fx',))
    """
    return parse_calibration(read_text(Path(path)), where=path)


def parse_calibration(text: str, *, where: object) -> Calibration:
    """Read a calibration from its text; `where` names it in messages.

    Raises
    ------
    FormatError
        When it is no calibration.

    Examples
    --------
    >>> parse_calibration('{"schema": "reseau-design/1"}', where="design.json")
    Traceback (most recent call last):
    reseau.core.errors.FormatError: design.json: has the schema 'reseau-design/1'; ...
    """
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise FormatError(f"is not JSON ({error})", where=where) from None
    if isinstance(content, dict) and content.get("schema") == FrameOrientation.SCHEMA:
        return calibration_of_frame(FrameOrientation.parse(text, where=where))
    if isinstance(content, dict) and content.get("schema") == FiducialOrientation.SCHEMA:
        return calibration_of_fiducials(FiducialOrientation.parse(text, where=where))
    return Calibration.parse(text, where=where)
