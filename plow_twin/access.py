"""Functions that check a host and read a secret, for connections to other programs."""

from __future__ import annotations

import os
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from plow_twin.errors import InputError, Problem

#: Largest length [B] of a secret. A longer password does not fit into an MQTT packet.
_LONGEST_SECRET: Final = 65_535


def is_address(host: str) -> bool:
    """Return whether a host is an IP address and not a name."""
    try:
        ip_address(host)
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Return whether a host is this machine."""
    return host == "localhost" or (is_address(host) and ip_address(host).is_loopback)


def in_url(host: str) -> str:
    """Return a host as in a URL, where an IPv6 address has brackets."""
    return f"[{host}]" if ":" in host else host


def read_secret(path: Path) -> str:
    """Return a password or token, which is the first line of a file.

    Raises
    ------
    InputError
        The line is too long, or contains unprintable characters. The message does not contain the line.
    OSError
        The file cannot be read.
    """
    with path.open("rb") as file:
        line = file.readline(_LONGEST_SECRET + 2).removesuffix(b"\n").removesuffix(b"\r")
    try:
        text = line.decode()
    except UnicodeDecodeError:
        text = "\0"
    if len(line) > _LONGEST_SECRET or not text.isprintable():
        expected = f"a password or token, at most {_LONGEST_SECRET} printable bytes"
        raise InputError([Problem("line 1", f"{len(line)} bytes", expected)], str(path))
    return text


def secret(path: Path | None, variable: str) -> str:
    """Return the secret in a file or, if `path` is None, in the environment variable `PLOW_TWIN_<variable>`."""
    return os.environ.get(f"PLOW_TWIN_{variable}", "") if path is None else read_secret(path)


def key_format(data: bytes) -> str:
    """Return the format of a certificate or key, `pem` or `der`. The name, such as `twin.key`, does not show it."""
    return "pem" if b"-----BEGIN" in data else "der"
