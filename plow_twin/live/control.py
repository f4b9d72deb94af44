"""A local socket through which a twin without ROS offers the services of the node.

Request and answer are single datagrams, so that a slow client cannot block the twin.
"""

from __future__ import annotations

import json
import os
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from plow_twin.errors import PlowTwinError
from plow_twin.live.service_names import SERVICES

if TYPE_CHECKING:
    from plow_twin.live.services import Services

_LARGEST: Final = 65536
#: Largest number of requests that are answered in one call of `Control.turn`.
_MOST: Final = 8
_PATIENCE_S: Final = 5.0
#: Interval between the calls of `Control.turn` [s].
TURN_S: Final = 0.1


class ControlError(PlowTwinError):
    """The socket cannot be opened, or does not answer."""


class Control:
    """Context manager that opens the socket of a twin. Only the user who runs the twin can connect to it.

    The attribute `services` must be set before clients can request a service.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.services: Services | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            if path.is_socket() and not _is_open(str(path)):
                path.unlink()
            before = os.umask(0o177)
            try:
                self._socket.bind(str(path))
            finally:
                os.umask(before)
        except OSError as error:
            self._socket.close()
            raise ControlError(f"{path}: cannot be a socket: {error.strerror or error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def turn(self) -> None:
        """Answer the requests that have arrived."""
        for _ in range(_MOST):
            try:
                data, client = self._socket.recvfrom(_LARGEST)
            except BlockingIOError:
                return
            if client and not _waits(client):
                continue  # the client has reported that no twin answers
            done, message = self._answer(data)
            try:
                self._socket.sendto(json.dumps({"success": done, "message": message}).encode(), client or b"")
            except OSError:
                continue  # the client has ended or does not read its answer

    def _answer(self, data: bytes) -> tuple[bool, str]:
        try:
            request: Any = json.loads(data)
        except ValueError:
            request = None
        name = request.get("service") if isinstance(request, dict) else None
        text = request.get("text") if isinstance(request, dict) else None
        if name not in SERVICES or self.services is None:
            return False, f"service: got {name!r}, expected one of {', '.join(SERVICES)}"
        return self.services.call(name, text if isinstance(text, str) else None)


def call(path: Path, service: str, text: str | None = None) -> tuple[bool, str]:
    """Request a service from a twin through its socket; return success and the answer of the twin."""
    if not path.is_socket():
        kind = "a folder" if path.is_dir() else "a file" if path.exists() else "nothing there"
        raise ControlError(f"{path}: got {kind}, expected the socket that plow-twin live --control has opened")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
        client.bind("")  # the operating system assigns an address that is not a file
        client.settimeout(_PATIENCE_S)
        try:
            client.connect(str(path))
            client.send(json.dumps({"service": service, "text": text}).encode())
            answer = json.loads(client.recv(_LARGEST))
        except OSError as error:
            gone = isinstance(error, ConnectionRefusedError)
            reason = "the twin that opened it has ended" if gone else error.strerror or f"nothing for {_PATIENCE_S:g} s"
            raise ControlError(f"{path}: no twin answers: {reason}") from error
    return bool(answer["success"]), str(answer["message"])


def _is_open(address: bytes | str) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(address)
        except ConnectionRefusedError:
            return False
    return True


def _waits(client: bytes | str) -> bool:
    try:
        return _is_open(client)
    except PermissionError:
        return True  # an open client is connected to the twin and accepts no other peer
    except OSError:
        return False
