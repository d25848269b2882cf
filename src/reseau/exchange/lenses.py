"""The one reader of lenses: our own documents, Zemax and CODE V, known by their content."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import FormatError
from ..io import LensDocument, LensSensor
from ..optics.lenses import Prescription
from .codev import read_codev
from .lines import read_bytes
from .prescribed import MOST_MB
from .zemax import read_zemax


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens as read from a file.

    Parameters
    ----------
    prescription : Prescription
    sensor : LensSensor, optional
        The sensor in its image plane, if the file has one.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, glass, in_order
    >>> rows = [(0.02, 5.0, glass("N-BK7")), (-0.02, 46.5, AIR)]
    >>> Lens(Prescription(in_order(rows), stop=0, stop_radius=5.0)).sensor is None
    True
    """

    prescription: Prescription
    sensor: LensSensor | None = None


def read_lens(path: Path | str) -> Lens:
    """Read a lens: ``lens/1`` (TOML), Zemax ``.zmx``, CODE V ``.seq``.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is none of them, or has something that is not supported, which is named.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.optics.lenses import AIR, glass, in_order
    >>> rows = [(0.02, 5.0, glass("N-BK7")), (-0.02, 46.5, AIR)]
    >>> singlet = Prescription(in_order(rows), stop=0, stop_radius=5.0, name="singlet")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     LensDocument.of(singlet).write(Path(folder) / "lens.toml")
    ...     lens = read_lens(Path(folder) / "lens.toml")
    >>> lens.prescription.name, lens.sensor
    ('singlet', None)
    """
    path = Path(path)
    text = read_bytes(path, MOST_MB)[:1_000_000].replace(b"\0", b"").decode("latin-1")
    if re.search(r"^\s*schema\s*=", text, re.MULTILINE) or path.suffix.lower() == ".toml":
        document = LensDocument.read(path)
        return Lens(document.prescription(), document.sensor)
    if re.search(r"^\s*SURF\s+\d+\s*$", text, re.MULTILINE):
        return Lens(read_zemax(path))
    if re.search(r"^(.*;)?\s*so\s+[-+.\d]\S*\s+([-+.\d]|inf)", text, re.MULTILINE | re.IGNORECASE):
        return Lens(read_codev(path))
    raise FormatError("is not a lens", where=path, do="expected lens/1 in TOML, Zemax .zmx, or CODE V .seq")
