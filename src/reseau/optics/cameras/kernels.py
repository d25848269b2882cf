"""Compiled cameras: kernels for one observation, and how loops over observations are compiled with them.

A kernel is a plain Python function, decorated with :func:`kernel`, that Numba can compile. It may call other
kernels by their global names. Such a name can be a *slot*: :func:`compiled` puts another kernel in its place,
so that one loop over observations is compiled for each camera model, and the call costs nothing. Numba is
imported at the first compilation, not with this module.

The kernel of a camera model has the signature ``kernel(k, c, e, u, v, xy, cameras, by_uv, d, more, off)``. It
receives an ideal direction (u, v) and the measured image point ``xy[k]`` (px), and writes

- ``off`` (2,): the misfit v, computed less measured (px),
- ``by_uv`` (2, 2): its derivatives by u and v,
- ``d`` (2, parameters): its derivatives by the parameters of the model, in their order,
- ``more`` (2, additional parameters): those by the additional parameters; only where e ≥ 0.

``c`` is the row of the camera in `cameras`, a :class:`CameraColumns`, and ``e`` the row of the set of
additional parameters, or −1. A kernel indexes the arrays of `cameras` by element: a row taken out of them
would count its references in all threads at once. Kernels that are called by others, and allocate no array,
are compiled without counting of references, which would take ten times as long as their arithmetic.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar, cast

from ...core.data import Array

__all__ = ["CameraColumns", "Kernel", "additional", "camera", "compiled", "kernel"]

# Functions of NumPy in kernels that allocate arrays.
_ALLOCATING = {"array", "copy", "empty", "full", "ones", "zeros"}

P = ParamSpec("P")
R = TypeVar("R")


class CameraColumns(NamedTuple):
    """Cameras and sets of additional parameters, as the kernels receive them.

    Parameters
    ----------
    values : ndarray (c, p)
        Parameters, in the order of each model; padded to the longest.
    constants : ndarray (c, q)
        What a model computes from its options; padded to the longest.
    grid : ndarray (c, 4)
        Centre of the image (px) and pitch (mm).
    extra : ndarray (e, a)
        Values of the additional parameters; padded to the longest.
    base : ndarray (e, 2)
        Base of the additional parameters (mm), and their degree.
    """

    values: Array
    constants: Array
    grid: Array
    extra: Array
    base: Array


class Kernel(Generic[P, R]):
    """A function that :func:`compiled` compiles; called directly, it runs as plain Python.

    Parameters
    ----------
    function : callable
        Defined in a module, without free variables.
    """

    def __init__(self, function: Callable[P, R]) -> None:
        self.function = function
        self.__name__, self.__doc__ = function.__name__, function.__doc__

    def __call__(self, *arguments: P.args, **named: P.kwargs) -> R:
        """Run the function as plain Python."""
        return self.function(*arguments, **named)


def kernel(function: Callable[P, R]) -> Kernel[P, R]:
    """Decorate a function as a kernel.

    Examples
    --------
    >>> @kernel
    ... def twice(x):
    ...     return 2.0 * x
    >>> twice(1.5)
    3.0
    """
    return Kernel(function)


def compiled(function: Kernel[P, R], **slots: Kernel[..., Any]) -> Callable[P, R]:
    """Compile a kernel, with other kernels in its slots.

    The machine code is cached on disk under a digest of all its source files, so that a change in
    one of them never runs old code. It releases the interpreter's lock.

    Parameters
    ----------
    function : Kernel
        To be compiled.
    **slots : Kernel
        Kernels by the global names at which `function`, or a kernel that it calls, calls them.

    Examples
    --------
    >>> from reseau.optics.cameras import camera_model
    >>> compiled(camera_model("opencv").kernel).__name__
    '_opencv'
    """
    return cast(Callable[P, R], _compiled(function, **slots))


@cache
def _compiled(
    function: Kernel[..., Any], *, called_by: bool = False, **slots: Kernel[..., Any]
) -> Callable[..., Any]:
    """See :func:`compiled`; `called_by` tells that the kernel is only called by compiled ones."""
    import numba

    inner = function.function
    assert isinstance(inner, FunctionType)
    names = dict.fromkeys(_called(function))
    called = {name: slots.get(name, inner.__globals__[name]) for name in names}
    own = FunctionType(
        inner.__code__,
        inner.__globals__
        | {name: _compiled(other, called_by=True, **slots) for name, other in called.items()},
        inner.__name__,
    )
    digest = _digest(function, slots)
    own.__module__, own.__doc__ = inner.__module__, inner.__doc__
    own.__qualname__ = f"{inner.__qualname__}_{digest[:16]}" if digest else inner.__qualname__
    # Machine code from the cache is not inlined: only what is called from Python is cached.
    options: dict[str, Any] = {"cache": bool(digest) and not called_by, "nogil": True, "error_model": "numpy"}
    if called_by and not _allocates(function, slots):
        options["_nrt"] = False
    return cast(Callable[..., Any], numba.njit(**options)(own))


def _called(function: Kernel[..., Any]) -> list[str]:
    """Global names at which a kernel calls kernels."""
    inner = cast(FunctionType, function.function)
    return [name for name in inner.__code__.co_names if isinstance(inner.__globals__.get(name), Kernel)]


def _allocates(function: Kernel[..., Any], slots: dict[str, Kernel[..., Any]]) -> bool:
    """Whether a kernel, or one that it calls, allocates arrays."""
    inner = cast(FunctionType, function.function)
    others = [slots.get(name, inner.__globals__[name]) for name in _called(function)]
    own = bool(_ALLOCATING & set(inner.__code__.co_names))
    return own or any(_allocates(other, slots) for other in others)


def _digest(function: Kernel[..., Any], slots: dict[str, Kernel[..., Any]]) -> str:
    """Digest of the kernels and of their source files; empty if one is not in a file."""
    # How they are compiled is in this file.
    digest, todo, done = hashlib.sha256(Path(__file__).read_bytes()), [function], list[Kernel[..., Any]]()
    while todo:
        current = todo.pop()
        done.append(current)
        inner = cast(FunctionType, current.function)
        path = Path(inspect.getfile(inner))
        if not path.is_file():
            return ""
        digest.update(f"{inner.__module__}.{inner.__qualname__}".encode())
        digest.update(path.read_bytes())
        others = [slots.get(name, inner.__globals__[name]) for name in _called(current)]
        todo += [other for other in others if other not in done]
    return digest.hexdigest()


@kernel
def camera(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array,
    more: Array, off: Array,
) -> None:  # fmt: skip
    """Slot for the kernel of a camera model."""


@kernel
def additional(
    e: int, x: float, y: float, cameras: CameraColumns, dx: float, dy: float, sxx: float, sxy: float,
    syx: float, syy: float, more: Array,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """Slot for the kernel of additional parameters; by itself it adds nothing.

    Adds their effect at the photo-coordinates x, y (mm) to dx, dy and to the derivatives of these by x and y,
    and writes the derivatives by the parameters into `more`.
    """
    return dx, dy, sxx, sxy, syx, syy
