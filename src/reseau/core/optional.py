"""Packages that only some features need: a missing one is one line that names it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from .errors import UsageError

_DISTRIBUTIONS = {
    "apprise": "reseau[service]",
    "argon2": "reseau[service]",
    "bluesky": "reseau[bench]",
    "cryptography": "reseau[service]",
    "dateutil": "reseau[service]",
    "distributed": "reseau[scale]",
    "fastapi": "reseau[service]",
    "fsspec": "reseau[bench]",
    "gi": "reseau[aravis]",
    "httpx": "reseau[service]",
    "imagecodecs": "reseau[photographs]",
    "jinja2": "jinja2",
    "lxml": "reseau[certificates]",
    "markupsafe": "jinja2",
    "matplotlib": "matplotlib",
    "mpl_toolkits": "matplotlib",
    "numba": "numba",
    "pandas": "pandas",
    "pillow_heif": "reseau[photographs]",
    "prometheus_client": "reseau[service]",
    "psutil": "reseau[bench]",
    "psycopg": "reseau[scale]",
    "pydicom": "reseau[dicom]",
    "pypdf": "reseau[certificates]",
    "python_multipart": "reseau[service]",
    "rawpy": "reseau[photographs]",
    "pyvisa": "reseau[bench]",
    "saxonche": "reseau[certificates]",
    "serial": "reseau[bench]",
    "sqlalchemy": "reseau[bench]",
    "starlette": "reseau[service]",
    "tifffile": "tifffile",
    "tomlkit": "reseau[bench]",
    "usb": "reseau[bench]",
    "uvicorn": "reseau[service]",
    "weasyprint": "reseau[certificates]",
    "xmlsec": "reseau[certificates]",
    "zaber_motion": "zaber-motion",
}
"""What to install, by the package that is imported."""


def missing(error: ImportError) -> UsageError | None:
    """Return the error that names a missing package, or None when the error is not about an optional one.

    Parameters
    ----------
    error : ImportError
        As raised by the import.

    Examples
    --------
    >>> print(missing(ModuleNotFoundError("No module named 'serial'", name="serial.tools")))
    needs serial, which is not installed; pip install 'reseau[bench]'
    """
    package = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or package not in _DISTRIBUTIONS:
        return None
    wanted = _DISTRIBUTIONS[package]
    quoted = f"'{wanted}'" if "[" in wanted else wanted
    return UsageError(f"needs {package}, which is not installed", do=f"pip install {quoted}")


@contextmanager
def optional() -> Iterator[None]:
    """Raise a UsageError where an import in this context misses an optional package.

    Raises
    ------
    UsageError
        With the name of the package and the command that installs it.

    Examples
    --------
    >>> with optional():
    ...     raise ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib")
    Traceback (most recent call last):
    reseau.core.errors.UsageError: needs matplotlib, which is not installed; pip install matplotlib
    """
    try:
        yield
    except ModuleNotFoundError as error:
        named = missing(error)
        if named is None:
            raise
        raise named from None
