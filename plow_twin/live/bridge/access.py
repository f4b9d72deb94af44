"""Address and credentials of a broker or server."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from plow_twin.live.bridge.source import BridgeError


@dataclass(frozen=True)
class Access:
    """Address and credentials.

    `url` is `SCHEME://HOST:PORT`; without a host it is this machine. `user` and `password` may be empty. `ca` is the
    authority, or the certificate itself, that the other side's certificate is checked against; `certificate` and `key`
    identify this side, `user_certificate` and `user_key` its user in the place of name and password. `plain` allows a
    connection to another machine without encryption. `client_id` names the session at a broker.
    """

    url: str
    user: str = ""
    password: str = ""
    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    user_certificate: Path | None = None
    user_key: Path | None = None
    plain: bool = False
    client_id: str = "plow_twin"


def host_and_port(access: Access, ports: Mapping[str, int], *, has_path: bool = False) -> tuple[str, str, int]:
    """Return scheme, host and port of an address; `ports` are the default ports by scheme.

    Raises
    ------
    BridgeError
        The address is invalid, or it contains a user, a password or, unless it `has_path`, a path.
    """
    expected = " or ".join(f"{scheme}://HOST:PORT" for scheme in ports)
    try:
        parts = urlsplit(access.url)
        host, port = parts.hostname or "localhost", parts.port or ports[parts.scheme]
    except (ValueError, KeyError) as error:
        raise BridgeError(f"{access.url}: expected {expected}") from error
    if parts.username or parts.password or (parts.path.strip("/") and not has_path):
        raise BridgeError(f"{parts.scheme}://...{parts.path}: expected {expected}, user and topics stand elsewhere")
    return parts.scheme, host, port


def is_loopback(host: str) -> bool:
    """Return whether a host is this machine."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
