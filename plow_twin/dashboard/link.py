"""Link between a twin and a separate process. It passes messages of limited size, and never blocks."""

from __future__ import annotations

import json
import math
import socket
from contextlib import suppress
from typing import Any, Final

LONGEST: Final = 1 << 16
#: Size of the buffer for messages that the receiving process has not read [B].
_ROOM: Final = 1 << 18


class Link:
    """One end of the link, a socket of type SOCK_SEQPACKET. Each message is a JSON object."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _ROOM)
        self._end = end
        self.broken = False

    def fileno(self) -> int:
        """Return the file descriptor, for `select`."""
        return self._end.fileno()

    def send(self, message: dict[str, Any]) -> bool:
        """Send a message. Return False if the message is too long, the buffer is full, or there is no receiver."""
        data = json.dumps(message, separators=(",", ":")).encode()
        if self.broken or len(data) > LONGEST:
            return False
        try:
            return self._end.send(data) == len(data)
        except BlockingIOError:
            return False
        except OSError:
            self.broken = True
            return False

    def receive(self) -> dict[str, Any] | None:
        """Return the next message, or None if no message has arrived."""
        if self.broken:
            return None
        try:
            data = self._end.recv(LONGEST)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self.broken = True
            return None
        message: dict[str, Any] = json.loads(data)
        return message

    def close(self) -> None:
        """Close this end. The process at the opposite end is notified that the link is broken."""
        with suppress(OSError):
            self._end.close()
        self.broken = True


def pair() -> tuple[Link, socket.socket]:
    """Return the end for this process, and the socket for the separate process."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return Link(ours), theirs


def number(value: float) -> float | None:
    """Round a number to seven digits for JSON. Return None if the number is not finite."""
    return float(f"{value:.7g}") if math.isfinite(value) else None


def numbers(values: Any) -> list[float | None]:
    """Return the numbers of an array, each rounded by `number`."""
    return [number(value) for value in values.tolist()]
