"""Access to the operator's screen: the address, the token, and the allowed host names."""

from __future__ import annotations

import hmac
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from plow_twin.access import is_address, is_loopback, secret
from plow_twin.errors import InputError, Problem

_SHORTEST: Final = 16


class DashboardError(InputError):
    """The screen cannot be served at the requested address."""

    def __init__(self, key: str, got: object, expected: str) -> None:
        super().__init__([Problem(key, got, expected)], "dashboard")


@dataclass(frozen=True)
class PageAccess:
    """Address and token of the screen.

    Without a token, all users of this machine can see the screen and acknowledge alarms.
    """

    host: str
    port: int
    token: str = ""

    @classmethod
    def of(cls, listen: str, token_file: Path | None) -> PageAccess:
        """Return the access for HOST:PORT, with the token in the first line of a file or in the environment.

        Raise `DashboardError` if the address is invalid, or if other machines can reach it without a token.
        """
        try:
            parts = urlsplit(f"//{listen}")
            host, port = parts.hostname or "", parts.port
        except ValueError:
            host, port = "", None
        if not host or port is None or parts.path or parts.username:
            raise DashboardError("--listen", listen, "HOST:PORT, such as 127.0.0.1:8070; port 0 selects a free port")
        token = secret(token_file, "DASHBOARD_TOKEN").strip()
        if token and (len(token) < _SHORTEST or not token.isascii() or not token.isprintable()):
            raise DashboardError("token", f"{len(token)} characters", f"at least {_SHORTEST} of ASCII, without spaces")
        if not token and not is_loopback(host):
            expected = "127.0.0.1, or a token: --token-file, or PLOW_TWIN_DASHBOARD_TOKEN in the environment"
            raise DashboardError("--listen", listen, expected)
        return cls(host, port, token)

    def admits(self, token: object) -> bool:
        """Compare a token with the token of the screen, in a time that does not depend on the tokens."""
        text = token if isinstance(token, str) else ""
        return hmac.compare_digest(text.encode("utf-8", "replace"), self.token.encode())

    def answers_to(self, host: str) -> bool:
        """Return whether the screen can be requested under the name in the header `Host`.

        Unknown host names are rejected, because a foreign page could read the screen by DNS rebinding.
        """
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if is_loopback(name) or name == self.host.lower():
            return True
        return not is_loopback(self.host) and (is_address(name) or name in (socket.gethostname(), socket.getfqdn()))

    def is_own(self, origin: str | None, host: str) -> bool:
        """Return whether a request comes from the page itself, or from a program that is not a browser."""
        try:
            return origin is None or urlsplit(origin).netloc.lower() == host.lower()
        except ValueError:
            return False


def listening(access: PageAccess) -> socket.socket:
    """Return a listening socket. Raise `DashboardError` if the address is in use or does not belong to this machine."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(access.host, access.port, type=socket.SOCK_STREAM)[0]
        probe = socket.socket(family, kind)
        try:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            probe.listen()
        except OSError:
            probe.close()
            raise
    except OSError as error:
        got = f"{access.host}:{access.port}"
        raise DashboardError("--listen", got, f"a free address of this machine ({error.strerror})") from error
    return probe
