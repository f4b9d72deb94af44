"""Address of an MQTT broker or OPC UA server, and the credentials for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from plow_twin.access import secret
from plow_twin.errors import InputError
from plow_twin.live.bridge.source import BridgeError
from plow_twin.scene_file.validation import TEXT, mapping, validate
from plow_twin.scene_file.yaml_text import read_yaml

_FILES: Final = ("ca", "certificate", "key", "user_certificate", "user_key", "password_file")
_CREDENTIALS: Final = mapping(
    {"user": TEXT, "plain": {"type": "boolean", "description": "true or false"}, **dict.fromkeys(_FILES, TEXT)}
)


@dataclass(frozen=True)
class Access:
    """Address `SCHEME://HOST:PORT` of a broker or server, and the credentials for it.

    An address without a host refers to this machine. `ca` is the certificate of a trusted authority, of the broker or
    of the server. `user_certificate` replaces the name and the password. With `plain`, an unencrypted connection to
    another machine is allowed. `client_id` is the name of the session at an MQTT broker.
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
    """Return scheme, host and port of an address. `ports` contains the default port of each scheme.

    Raise `BridgeError` if the address is invalid or contains a user, a password, or a path although `has_path` is
    False.
    """
    expected = " or ".join(f"{scheme}://HOST:PORT" for scheme in ports)
    try:
        parts = urlsplit(access.url)
        host, port = parts.hostname or "localhost", parts.port or ports[parts.scheme]
    except (ValueError, KeyError) as error:
        raise BridgeError(f"{access.url}: expected {expected}") from error
    if parts.username or parts.password or (parts.path.strip("/") and not has_path):
        raise BridgeError(
            f"{parts.scheme}://...{parts.path}: expected {expected}, user and topics are set by other options"
        )
    return parts.scheme, host, port


def read_access(url: str, path: Path | None) -> Access:
    """Return the address of an OPC UA server with the credentials from a YAML file.

    The paths in the file are relative to the folder of the file.
    """
    if path is None:
        return Access(url, password=secret(None, "OPCUA_PASSWORD"))
    document, found = read_yaml(path, "credentials", _CREDENTIALS["description"])
    if problems := found or validate(document, _CREDENTIALS, "credentials"):
        raise InputError(problems, str(path))
    files: dict[str, Any] = {key: path.parent / document[key] for key in _FILES if key in document}
    password = secret(files.pop("password_file", None), "OPCUA_PASSWORD")
    return Access(url, document.get("user", ""), password, plain=document.get("plain", False), **files)
