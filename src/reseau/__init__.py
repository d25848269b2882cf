"""Calibrate cameras, scanned film and imaging instruments, and know how far to trust the result.

>>> import reseau
>>> sorted(reseau.__all__)[:4]
['Archive', 'Bench', 'Calibration', 'Code']

The names below are imported when they are first used, so that ``import reseau`` takes milliseconds:

- read files: :func:`read_image`, :func:`read_design`, :func:`read_calibration`,
  :func:`read_lens`
- compute: :func:`measure`, :func:`calibrate`, :func:`orient`, :func:`refine`, :func:`adjust_network`
- exchange: :class:`Frame`, :class:`ImagePoints`, :class:`Network`, :class:`Calibration`, :class:`Failure`
- instruments and their recordings: :class:`Bench`, :class:`Archive`

``reseau.measure`` and ``reseau.refine`` are both packages and functions: ``reseau.measure(image, design)``.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .core.lazy import lazily
from .core.version import __version__

if TYPE_CHECKING:
    from .api import (
        adjust_network,
        calibrate,
        measure,
        orient,
        read_calibration,
        read_design,
        read_image,
        read_lens,
        refine,
    )
    from .archive import Archive
    from .bundle import Network
    from .calibration import Calibration
    from .capture import Bench
    from .core.data import Frame, ImagePoints
    from .core.errors import ReseauError
    from .core.failure import Code, Failure

__all__ = [
    "Archive",
    "Bench",
    "Calibration",
    "Code",
    "Failure",
    "Frame",
    "ImagePoints",
    "Network",
    "ReseauError",
    "__version__",
    "adjust_network",
    "calibrate",
    "measure",
    "orient",
    "read_calibration",
    "read_design",
    "read_image",
    "read_lens",
    "refine",
]

_PLACES = {
    "Archive": ".archive",
    "Bench": ".capture",
    "Calibration": ".calibration",
    "Code": ".core.failure",
    "Failure": ".core.failure",
    "Frame": ".core.data",
    "ImagePoints": ".core.data",
    "Network": ".bundle",
    "ReseauError": ".core.errors",
}
"""Modules that define the names; all others are functions of :mod:`reseau.api`."""
_named = lazily(__name__, dict.fromkeys(__all__, ".api") | _PLACES)


def __getattr__(name: str) -> Any:
    return import_module(f".{name}", __name__) if name in _CALLABLE else _named(name)


def __dir__() -> list[str]:
    return sorted(__all__)


class _Callable(ModuleType):
    """A package that can be called like the function of :mod:`reseau.api` that has its name."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        function = getattr(import_module(".api", __name__), self.__name__.rpartition(".")[2])
        return function(*arguments, **options)


_CALLABLE = ("measure", "refine")


class _Package(ModuleType):
    """Makes the packages that share their names with functions callable when they are imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _CALLABLE and isinstance(value, ModuleType):
            value.__class__ = _Callable
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
