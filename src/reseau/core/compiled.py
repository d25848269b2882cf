"""Loops that Numba compiles at their first call, and that are kept on the disk.

:func:`compiled` decorates a function that Python calls, :func:`kernel` one that only compiled functions call.
Numba is imported at the first call, not with the module of a loop. A name at which a function calls a kernel
can be a *slot*: ``compiled(loop, camera=brown_kernel)`` is `loop` with another kernel at its global name
`camera`, so that one loop is compiled for each kernel, and the call costs nothing.

Machine code is kept in one file for each loop, types of its arguments and processor, in

1. the folder that ``NUMBA_CACHE_DIR`` names, where it is set;
2. the package, where it can be written to;
3. the user's folder of caches, for packages that belong to someone else. What is in the package is read.

A wheel brings machine code for the usual processors of its platform (``DELIVERED``), which is read where the
processor has what they have; see ``building/wheels.py``.

A file is found by a digest of what was compiled: the instructions and constants of the loop and of all that
it calls. So code that was changed never runs in its old form, and a copy, another installation or a checkout
with other times of its files finds what is there. A process waits for what another one compiles.

Kernels are compiled with each loop that calls them, and not kept by themselves: from the disk they could not
be inlined. A kernel is compiled for each literal number that it is called with: give ``np.intp(0)``, not 0.
One that allocates no array is compiled without counting references, which would take ten times as
long as its arithmetic; therefore it indexes arrays in tuples by element, and takes no row out of them.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import pickle
import platform
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache, update_wrapper
from importlib import import_module
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import IO, Any, Generic, ParamSpec, TypeVar, cast, overload

import numpy as np

from .errors import InputError
from .exclusive import lock_file
from .files import write_whole
from .notice import compiles

P = ParamSpec("P")
R = TypeVar("R")

_ALLOCATING = {"array", "copy", "empty", "empty_like", "full", "ones", "zeros", "zeros_like"}
"""Functions of NumPy in kernels that allocate arrays."""
_PATIENCE = 60.0
"""Seconds for which a process waits for what another one compiles, before it compiles itself."""
_SUFFIX = ".nbc"
DELIVERED = "machine_code"
"""Folder in the package with what a wheel brings."""
_V3 = ("x86-64-v3", frozenset(("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")))
_USUAL = {
    "x86_64": _V3,
    "amd64": _V3,
    "aarch64": ("generic", frozenset(("neon",))),
    "arm64": ("apple-m1", frozenset(("neon",))),
}
"""The usual processor of a platform, as LLVM names it, with what one must have that runs its machine code."""
_COMPILER = "optimised"
"""Module of the compiler, which imports Numba."""
_building = threading.RLock()


class Kernel(Generic[P, R]):
    """A function that compiled ones call; called directly, it runs as plain Python.

    Parameters
    ----------
    function : callable
        Defined in a module, without free variables.
    fastmath : set of str
        What the compiler may assume, as LLVM names it; nothing by default.
    """

    def __init__(self, function: Callable[P, R], fastmath: frozenset[str] = frozenset()) -> None:
        self.function, self.fastmath = cast(FunctionType, function), fastmath
        update_wrapper(self, function)

    def __call__(self, *arguments: P.args, **named: P.kwargs) -> R:
        """Run the function."""
        return cast(R, self.function(*arguments, **named))

    @property
    def name(self) -> str:
        """Module and name of the function."""
        return f"{self.function.__module__}:{self.function.__qualname__}"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the name: results that hold compiled functions are copied, and sent to processes."""
        return _found, (self.name,)


class Compiled(Kernel[P, R]):
    """A function that is compiled when it is called first.

    Parameters
    ----------
    function, fastmath
        As of a :class:`Kernel`.
    slots : mapping of str to Kernel
        Kernels by the global names at which the function, or one that it calls, calls them.
    """

    def __init__(
        self,
        function: Callable[P, R],
        fastmath: frozenset[str] = frozenset(),
        slots: Mapping[str, Kernel[..., Any]] | None = None,
    ) -> None:
        super().__init__(function, fastmath)
        self.slots = dict(slots or {})
        self._dispatcher: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the names of the function and of the kernels in its slots."""
        slots = {slot: each.name for slot, each in self.slots.items()}
        return (named, (self.name, slots)) if slots else super().__reduce__()

    @property
    def dispatcher(self) -> Any:
        """What Numba makes of it: compiles it for types of arguments, and calls it."""
        if self._dispatcher is None:
            with _building:
                self._dispatcher = self._dispatcher or _entry(self)
        return self._dispatcher

    def kept(self, types: tuple[Any, ...]) -> bool:
        """Whether a folder keeps it, compiled for types of arguments."""
        made = self.dispatcher
        names = made._cache.files(types, made.targetctx.codegen())
        return any((folder / name).exists() for name in names for folder in folders())

    def compile(self, types: tuple[Any, ...]) -> bool:
        """Compile it for types of arguments; return whether it had not been before."""
        made = self.dispatcher
        before = sum(made.stats.cache_misses.values())
        made.compile(types)
        return bool(sum(made.stats.cache_misses.values()) > before)

    def __call__(self, *arguments: P.args, **named: P.kwargs) -> R:
        """Run the compiled function."""
        return cast(R, (self._dispatcher or self.dispatcher)(*arguments, **named))


class Instruction:
    """An instruction of LLVM that compiled functions call by its global name.

    Parameters
    ----------
    function : callable
        What :func:`numba.extending.intrinsic` makes it of, when it is needed.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        update_wrapper(self, function)

    @property
    def made(self) -> Any:
        """What Numba makes of it."""
        return import_module("numba.extending").intrinsic(self.function)

    def __call__(self, *arguments: Any) -> None:
        """Refuse to run: only compiled functions call it."""
        raise TypeError(f"{self.function.__name__} is for compiled functions only")


def kernel(function: Callable[P, R]) -> Kernel[P, R]:
    """Decorate a function that compiled ones call.

    Examples
    --------
    >>> @kernel
    ... def twice(x):
    ...     return 2.0 * x
    >>> twice(1.5)
    3.0
    """
    return Kernel(function)


@overload
def compiled(function: Callable[P, R], /, **slots: Kernel[..., Any]) -> Compiled[P, R]: ...
@overload
def compiled(*, fastmath: frozenset[str]) -> Callable[[Callable[P, R]], Compiled[P, R]]: ...
def compiled(function: Any = None, /, *, fastmath: Any = frozenset(), **slots: Any) -> Any:
    """Compile a function at its first call; it releases the interpreter's lock, and divides as NumPy does.

    Parameters
    ----------
    function : callable
        A function, of which this is the decorator, or a kernel.
    fastmath : set of str
        What the compiler may assume, as LLVM names it; nothing by default.
    **slots : Kernel
        Kernels by the global names at which `function`, or a kernel that it calls, calls them.

    Examples
    --------
    >>> import numpy as np
    >>> from reseau.optics.compiled_corners import _normal
    >>> _normal(0.0)[0]
    0.5
    """
    if function is None:
        return lambda own: Compiled(own, fastmath)
    if isinstance(function, Kernel):
        return Compiled(function.function, function.fastmath, slots)
    return Compiled(function, fastmath, slots)


def named(name: str, slots: Mapping[str, str] | None = None) -> Compiled[..., Any]:
    """Return a compiled function by its name and those of the kernels in its slots, ``module:name`` each."""
    return compiled(_found(name), **{slot: _found(other) for slot, other in (slots or {}).items()})


def _found(name: str) -> Kernel[..., Any]:
    module, _, attribute = name.partition(":")
    found = getattr(import_module(module), attribute)
    if not isinstance(found, Kernel):
        raise TypeError(f"{name} is not compiled")
    return found


# Numba's functions are made when they are needed.


Slots = frozenset[tuple[str, Kernel[..., Any]]]


def _entry(function: Compiled[..., Any]) -> Any:
    """The dispatcher of a function that Python calls; what it compiles is kept."""
    made = _dispatcher(function, frozenset(function.slots.items()), called=False)
    made._cache = _Kept(function, _digest(function, frozenset(function.slots.items())))
    return made


@cache
def _called(function: Kernel[..., Any], slots: Slots) -> Any:
    """The dispatcher of a kernel that compiled functions call."""
    return _dispatcher(function, slots, called=True)


def _dispatcher(function: Kernel[..., Any], slots: Slots, called: bool) -> Any:
    import numba

    inner = function.function
    others = {name: _called(other, _within(other, slots)) for name, other in _calls(function, slots).items()}
    others |= {name: each.made for name, each in _globals(function).items() if isinstance(each, Instruction)}
    own = FunctionType(inner.__code__, inner.__globals__ | others, inner.__name__, inner.__defaults__)
    own.__module__, own.__doc__ = inner.__module__, inner.__doc__
    # Names of machine code must differ where slots do.
    own.__qualname__ = f"{inner.__qualname__}_{_digest(function, slots)[:16]}"
    # Nothing calls it by a pointer.
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    if function.fastmath:
        options["fastmath"] = set(function.fastmath)
    if called:
        # Nor does Python call it.
        options["no_cpython_wrapper"] = True
        if not _allocates(function, slots):
            options["_nrt"] = False
    else:
        options["pipeline_class"] = import_module(f".{_COMPILER}", __package__).Optimised
    return numba.njit(**options)(own)


def _codes(code: CodeType) -> Iterator[CodeType]:
    """The code of a function, and of what is defined in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _globals(function: Kernel[..., Any]) -> dict[str, Any]:
    """Global names that a function uses, with what they stand for."""
    around = function.function.__globals__
    names = dict.fromkeys(name for code in _codes(function.function.__code__) for name in code.co_names)
    return {name: around[name] for name in names if name in around}


def _calls(function: Kernel[..., Any], slots: Slots) -> dict[str, Kernel[..., Any]]:
    """Kernels that a function calls, by the names at which it calls them."""
    used, instead = _globals(function), dict(slots)
    return {name: instead.get(name, each) for name, each in used.items() if isinstance(each, Kernel)}


def _reached(function: Kernel[..., Any], slots: Slots) -> list[Kernel[..., Any]]:
    """A function, with all that it calls."""
    todo, done = [function], list[Kernel[..., Any]]()
    while todo:
        current = todo.pop()
        if current not in done:
            done.append(current)
            todo += _calls(current, slots).values()
    return done


def _within(function: Kernel[..., Any], slots: Slots) -> Slots:
    """Those of the slots that a function has."""
    names = {name for each in _reached(function, slots) for name in _calls(each, slots)}
    return frozenset(item for item in slots if item[0] in names)


def _allocates(function: Kernel[..., Any], slots: Slots) -> bool:
    """Whether a kernel, or one that it calls, may allocate arrays, or hold views of them."""
    return any(
        isinstance(each, Compiled) or _ALLOCATING & set(each.function.__code__.co_names)
        for each in _reached(function, slots)
    )


@cache
def _digest(function: Kernel[..., Any], slots: Slots) -> str:
    """Digest of what is compiled, of its constants, and of the versions that compile it."""
    import llvmlite
    import numba

    compilers = Path(__file__), Path(__file__).with_name(_COMPILER + ".py")
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in compilers))
    digest.update(repr((sys.version_info[:2], numba.__version__, llvmlite.__version__)).encode())
    for each in _reached(function, slots):
        calls = {name: other.name for name, other in _calls(each, slots).items()}
        digest.update(repr((each.name, sorted(each.fastmath), each.function.__defaults__, calls)).encode())
        for code in _codes(each.function.__code__):
            digest.update(code.co_code)
            digest.update(repr((code.co_names, code.co_varnames)).encode())
            for constant in code.co_consts:
                digest.update(_content(constant, each))
        for name, value in _globals(each).items():
            if name not in calls:
                digest.update(name.encode() + _content(value, each))
    return digest.hexdigest()


def _content(value: Any, function: Kernel[..., Any]) -> bytes:
    """What a compiled function takes from a constant."""
    if isinstance(value, np.ndarray):
        return repr((value.dtype, value.shape)).encode() + value.tobytes()
    if isinstance(value, frozenset):
        return repr(sorted(map(repr, value))).encode()
    if isinstance(value, CodeType):
        return b""
    if isinstance(value, ModuleType):
        return value.__name__.encode()
    module = getattr(value, "__module__", None)
    if module is None:
        return repr(value).encode()
    # A class or an instruction for the compiler: of this package, what its module says.
    found = f"{module}.{getattr(value, '__qualname__', type(value).__qualname__)}".encode()
    if module.partition(".")[0] == function.function.__module__.partition(".")[0]:
        with suppress(TypeError, OSError):
            found += Path(inspect.getfile(sys.modules[module])).read_bytes()
    return found


# What is kept.


def folders() -> list[Path]:
    """Return the folders in which machine code is looked for; it is written to the last of them."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return [Path(given) / "reseau"]
    package = Path(__file__).resolve().parents[1]
    beside = package / "__pycache__" / "compiled"
    exists = next(each for each in (beside, beside.parent, package) if each.is_dir())
    found = [package / DELIVERED] if (package / DELIVERED).is_dir() else []
    return [*found, beside, *([] if os.access(exists, os.W_OK) else [_own() / "reseau" / "compiled"])]


@cache
def usual_processor() -> tuple[str, str] | None:
    """Return the usual processor of this platform, and its features, where this one runs its machine code."""
    from llvmlite.binding import get_host_cpu_features

    name, needed = _USUAL.get(platform.machine().lower(), ("", frozenset()))
    has = {feature for feature, present in get_host_cpu_features().items() if present}
    return (name, "") if name and needed <= has else None


def _own() -> Path:
    """The folder of the user's caches."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


class _Kept:
    """Machine code of a function on the disk, as a dispatcher of Numba asks for it."""

    def __init__(self, function: Compiled[..., Any], digest: str) -> None:
        self._function, self._digest, self._folders = function, digest, folders()
        self._lock: tuple[IO[bytes], Path] | None = None

    @property
    def cache_path(self) -> str:
        return str(self._folders[-1])

    def enable(self) -> None:
        """Do nothing; it is always enabled."""

    def disable(self) -> None:
        """Do nothing; it is always enabled."""

    def flush(self) -> None:
        """Do nothing; what is kept belongs to what was compiled."""

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return what was compiled for a signature, or None when it is to be compiled."""
        names = self.files(signature, context.codegen())
        context.refresh()
        self._release()
        begun = time.monotonic()
        while True:
            for path in (folder / name for name in names for folder in self._folders):
                found = _read(path)
                if found is not None:
                    self._release()
                    return import_module("numba.core.compiler").CompileResult._rebuild(context, *found)
            patient = time.monotonic() - begun < _PATIENCE
            if self._lock is not None or not (self._locked(names[0]) or patient):
                compiles()
                return None
            if self._lock is None:
                time.sleep(0.05)

    def save_overload(self, signature: Any, done: Any) -> None:
        """Keep what was compiled for a signature."""
        dumps = import_module("numba.core.serialize").dumps

        if not done.library.has_dynamic_globals and not any(not each.can_cache for each in done.lifted):
            header = {
                "function": self._function.name,
                "slots": {slot: other.name for slot, other in self._function.slots.items()},
                "arguments": [_described(each) for each in _arguments(signature)],
            }
            content = json.dumps(header).encode() + b"\n" + dumps(done._reduce())
            with suppress(InputError):  # of a full disk or a closed folder: it is compiled again
                write_whole(self._folders[-1] / self.files(signature, done.codegen)[0], content)
                self._remove_earlier()
        self._release()

    def files(self, signature: Any, codegen: Any) -> list[str]:
        """Return the names of the files for a signature: of this processor, and of the usual one."""
        types = [_spelled(_described(each)) for each in _arguments(signature)]
        own = codegen.magic_tuple()
        usual = usual_processor()
        runs = [own] if usual is None else [own, (own[0], *usual)]
        keys = [hashlib.sha256(repr((types, each)).encode()).hexdigest()[:16] for each in runs]
        return [f"{self._stem}-{self._digest[:16]}-{key}{_SUFFIX}" for key in dict.fromkeys(keys)]

    @property
    def _stem(self) -> str:
        others = (other.function.__name__ for other in self._function.slots.values())
        return ".".join((self._function.name.replace(":", "."), *others))

    def _remove_earlier(self) -> None:
        """Remove what was compiled of the function before it was changed; not where others may use it."""
        if self._folders[-1].parent.name == "__pycache__":
            for path in self._folders[-1].glob(f"{self._stem}-*{_SUFFIX}"):
                if not path.name.startswith(f"{self._stem}-{self._digest[:16]}-"):
                    path.unlink(missing_ok=True)

    def _locked(self, name: str) -> bool:
        """Whether this process is to compile it; it is too where the folder cannot be written to."""
        path = self._folders[-1] / f".{name}.lock"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = path.open("wb")
        except OSError:
            self._lock = (open(os.devnull, "wb"), path)  # noqa: SIM115
            return True
        if not lock_file(handle):
            handle.close()
            return False
        self._lock = (handle, path)
        return True

    def _release(self) -> None:
        if self._lock is not None:
            handle, path = self._lock
            self._lock = None
            with suppress(OSError):
                path.unlink()
            handle.close()


def _arguments(signature: Any) -> tuple[Any, ...]:
    """Types of the arguments of a signature of Numba."""
    return tuple(getattr(signature, "args", signature))


def _read(path: Path) -> Any:
    """What a file of machine code contains; None without it, or where it cannot be read."""
    try:
        content = path.read_bytes()
        return pickle.loads(content[content.index(b"\n") + 1 :])
    except (OSError, ValueError, EOFError, pickle.UnpicklingError):
        return None


def listed(folder: Path) -> list[dict[str, Any]]:
    """Return function, slots and types of the arguments of everything that a folder keeps."""
    found = []
    for path in sorted(folder.glob(f"*{_SUFFIX}")):
        with path.open("rb") as stream:
            found.append(json.loads(stream.readline()))
    return found


# Types of arguments as JSON: [element, dimensions, layout, writeable] of an array, {"of": […]} of a tuple.


def _described(kind: Any) -> Any:
    types: Any = import_module("numba.types")

    if isinstance(kind, types.Array):
        return [str(kind.dtype), kind.ndim, kind.layout, kind.mutable]
    if isinstance(kind, types.BaseNamedTuple):
        own = kind.instance_class
        return {"class": f"{own.__module__}:{own.__qualname__}", "of": [_described(each) for each in kind]}
    if isinstance(kind, types.BaseTuple):
        return {"of": [_described(each) for each in kind]}
    return str(kind)


def _spelled(described: Any) -> str:
    """A type with the fields of its classes, which their order decides about."""
    if isinstance(described, dict):
        module, _, name = described.get("class", "").partition(":")
        fields = getattr(sys.modules[module], name, None) if module else None
        return repr((name, getattr(fields, "_fields", ()), [_spelled(each) for each in described["of"]]))
    return repr(described)


def types_of(described: list[Any]) -> tuple[Any, ...]:
    """Return types of Numba as :func:`listed` describes them.

    Examples
    --------
    >>> types_of(["float64", ["float32", 2, "C", False], {"of": ["int64", "int64"]}])
    (float64, Array(float32, 2, 'C', True, aligned=True), UniTuple(int64, 2))
    """
    return tuple(_type(each) for each in described)


def _type(described: Any) -> Any:
    types: Any = import_module("numba.types")

    if isinstance(described, str):
        return getattr(types, {"bool": "boolean"}.get(described, described))
    if isinstance(described, list):
        element, dimensions, layout, writeable = described
        return types.Array(_type(element), dimensions, layout, readonly=not writeable)
    if "class" not in described:
        return types.Tuple(types_of(described["of"]))
    module, _, name = described["class"].partition(":")
    of = types_of(described["of"])
    own = getattr(import_module(module), name)
    if len(set(of)) == 1:
        return types.NamedUniTuple(of[0], len(of), own)
    return types.NamedTuple(of, own)
