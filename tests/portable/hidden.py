"""Plugin of pytest that hides from this project what Windows or macOS lack: ``-p tests.portable.hidden``.

Only the packages of this project see less: modules are not found, and `os`, `signal`, `select`, `socket` and
`multiprocessing` are stand-ins without the names that other systems do not have. Python's own modules and
other packages, which have their own ways on other systems, are left as they are. `msvcrt` is there with its
lock.
"""

from __future__ import annotations

import builtins
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import pytest

MODULES = {"fcntl", "pty", "termios", "tty", "pwd", "grp", "resource", "syslog", "crypt"}
"""Modules that Windows does not have."""
NAMES = {
    "os": (
        "fork", "forkpty", "openpty", "getuid", "geteuid", "getgid", "fchmod", "chown", "mkfifo", "killpg",
        "setsid", "posix_spawn", "sched_getaffinity", "memfd_create", "WNOHANG", "O_NOFOLLOW", "O_DIRECTORY",
        "O_CLOEXEC", "O_NONBLOCK", "set_blocking", "ttyname",
    ),
    "signal": ("SIGKILL", "SIGHUP", "SIGALRM", "SIGUSR1", "SIGUSR2", "SIGCHLD", "pthread_sigmask"),
    "select": ("poll", "epoll"),
    "socket": ("AF_UNIX", "SOCK_SEQPACKET", "recv_fds", "send_fds"),
    "mmap": ("MAP_SHARED", "PROT_READ", "PROT_WRITE"),
}  # fmt: skip
"""Names that modules do not have there."""
PROJECT = ("reseau", "reseau_drivers", "reseau_sims")


def _without(module: ModuleType, names: Sequence[str]) -> ModuleType:
    def found(name: str) -> Any:
        if name in names:
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}", name=name)
        return getattr(module, name)  # asked each time: a test may have replaced it

    made = ModuleType(module.__name__)
    made.__dict__["__getattr__"] = found
    made.__dict__["__dir__"] = lambda: [name for name in dir(module) if name not in names]
    return made


def _locking() -> ModuleType:
    """What Windows has in place of `fcntl`: its lock of a byte, which is the lock of a file here."""
    import fcntl

    def locking(number: int, mode: int, length: int) -> None:
        assert (mode, length) == (made.__dict__["LK_NBLCK"], 1)
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)

    made = ModuleType("msvcrt")
    made.__dict__.update(locking=locking, LK_NBLCK=2)
    return made


def hide() -> None:
    """Hide them from now on; what was imported before sees them."""
    import getpass  # noqa: F401  # modules that ask for `msvcrt` to know the system
    import subprocess  # noqa: F401

    sys.modules["msvcrt"] = _locking()
    assert not any(name.partition(".")[0] in PROJECT for name in sys.modules), "imported before"
    real = builtins.__import__
    shown = {name: _without(real(name), names) for name, names in NAMES.items()}
    multiprocessing = _without(real("multiprocessing"), ())
    multiprocessing.__dict__["get_all_start_methods"] = lambda: ["spawn"]
    shown["multiprocessing"] = multiprocessing

    def seen(
        name: str,
        globals: dict[str, Any] | None = None,
        locals: dict[str, Any] | None = None,
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> Any:
        importer = str((globals or {}).get("__name__", "")).partition(".")[0]
        if importer in PROJECT and not level:
            if name in MODULES:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)
            if name in shown:
                return shown[name]
        return real(name, globals, locals, fromlist, level)

    builtins.__import__ = seen  # type: ignore[assignment]


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests() -> None:
    """Hide them before the first file of the tests is imported."""
    hide()
