"""A serial instrument behind ``/dev/ttyACM0``: the other end of a USB modem's line."""

from __future__ import annotations

import os
import select
import termios
import threading
import time
import tty
from contextlib import suppress

from reseau_sims.serving import Session

from .gadget import Gadget, appeared

__all__ = ["SerialPort"]

_POLL_S = 0.05


class SerialPort:
    """The line; what answers on it may be changed at any time.

    Parameters
    ----------
    session : Session
        What answers first.
    """

    NODE = "/dev/ttyACM0"

    def __init__(self, session: Session) -> None:
        self.session = session
        self.gadget = Gadget("line", 0x0002, "LINE1", 1)
        number = int((self.gadget.function("acm.0") / "port_num").read_text())
        self.gadget.plug_in()
        self._device = appeared(f"/dev/ttyGS{number}")
        threading.Thread(target=self._serve, daemon=True).start()

    def _opened(self) -> int:
        fd = os.open(self._device, os.O_RDWR | os.O_NOCTTY)
        # Otherwise it echoes, and edits what comes.
        tty.setraw(fd, termios.TCSANOW)
        return fd

    def _serve(self) -> None:
        fd = self._opened()
        while True:
            asked = select.select([fd], [], [], _POLL_S)[0]
            self._say(fd)  # also to a client that never stops asking
            if not asked:
                continue
            try:
                data = os.read(fd, 4096)
            except OSError:
                data = b""
            pulled = bool(data) and self._answered(fd, data)
            if data and not pulled:
                continue
            # Unplugged, the kernel hangs this end up too; it is given back before the next one is there.
            if pulled:
                self.gadget.unplug()
            os.close(fd)
            self.session.disconnected()
            if pulled:
                self.gadget.plug_in()
            else:
                time.sleep(0.05)
            fd = self._opened()

    def _say(self, fd: int) -> None:
        """Send what the instrument says unasked, if it is due."""
        due = getattr(self.session, "due", None)
        if due is not None and due <= time.monotonic():
            for _, data in self.session.emit():  # type: ignore[attr-defined]
                with suppress(OSError):  # the next read finds out
                    os.write(fd, data or b"")

    def _answered(self, fd: int, data: bytes) -> bool:
        """Whether the plug is to be pulled, after what was answered."""
        for seconds, answer in self.session.receive(data):
            time.sleep(seconds)
            if answer is None:
                return True
            with suppress(OSError):  # the next read finds out
                os.write(fd, answer)
        return False
