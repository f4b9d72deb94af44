"""Create the descriptions of outputs from addresses, and from credentials in files or in the environment."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from plow_twin.access import in_url, is_loopback, secret
from plow_twin.errors import InputError, Problem
from plow_twin.scene_file.validation import TEXT, mapping, validate
from plow_twin.scene_file.yaml_text import read_yaml

_PORTS: Final = {"mqtt": 1883, "mqtts": 8883, "opc.tcp": 4840, "http": 8086, "https": 443}
_CREDENTIALS: Final = mapping(
    {
        "mqtt": mapping(dict.fromkeys(("user", "password_file", "ca", "certificate", "key", "client_id"), TEXT)),
        "influx": mapping(dict.fromkeys(("token_file", "ca"), TEXT)),
        "opcua": mapping(dict.fromkeys(("user", "password_file", "certificate", "key", "trusted"), TEXT)),
    }
)


class AccessError(InputError):
    """The description of an output cannot be used."""

    def __init__(self, key: str, got: object, expected: str) -> None:
        super().__init__([Problem(key, got, expected)], "telemetry")


#: Not allowed in the name of a topic: wildcards, control characters, a `$` at the beginning, and a length at which the
#: name may exceed the 65,535 bytes of MQTT.
_NO_TOPIC: Final = re.compile(r"[+#\x00-\x1f]|^\$|.{16000}")


@dataclass(frozen=True)
class OutputSpec:
    """Description of an output.

    `name` is its part of the diagnostics, and `address` contains no credentials. The process of the output imports
    `modules` and receives the message `first`, which contains the options. With `may_acknowledge`, an operator at the
    receiver may acknowledge alarms.
    """

    name: str
    address: str
    modules: tuple[str, ...]
    first: dict[str, Any] = field(repr=False)
    may_acknowledge: bool = False


@dataclass(frozen=True)
class Credentials:
    """Credentials in the sections `mqtt`, `opcua` and `influx`. Paths are relative to the folder of the file."""

    sections: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, repr=False)
    folder: Path = Path()

    @classmethod
    def read(cls, path: Path | None) -> Credentials:
        """Read a YAML file. Raise `InputError` or `OSError` if the file cannot be used."""
        if path is None:
            return cls()
        data, found = read_yaml(path, "credentials", _CREDENTIALS["description"])
        if problems := found or validate(data, _CREDENTIALS, "credentials"):
            raise InputError(problems, str(path))
        return cls(data, path.parent)

    def text(self, section: str, key: str, default: str = "") -> str:
        """Return a value of a section, or `default` if the value is missing."""
        return str(self.sections.get(section, {}).get(key, default))

    def file(self, section: str, key: str) -> str | None:
        """Return the absolute path of a file, or None if the section has no path.

        `AccessError` is raised if the file does not exist.
        """
        name = self.text(section, key)
        if not name:
            return None
        path = (self.folder / name).absolute()
        if not path.exists():
            raise AccessError(f"{section}.{key}", str(path), "a file")
        return str(path)

    def secret(self, section: str, key: str, variable: str) -> str:
        """Return the secret in the stated file or, if no file is stated, in `PLOW_TWIN_<variable>`."""
        path = self.file(section, key)
        return secret(None if path is None else Path(path), variable)


def mqtt_out(url: str, credentials: Credentials, *, plain: bool, sparkplug: str = "") -> list[OutputSpec]:
    """Return the outputs to an MQTT broker at `mqtt[s]://HOST[:PORT]/PREFIX`.

    `sparkplug` is GROUP/NODE of an edge node of Sparkplug. With `sparkplug`, JSON messages are sent only if `url` has a
    prefix. `AccessError` or `OSError` is raised if an address, a name or a file cannot be used.
    """
    expected = "mqtt[s]://HOST:PORT/PREFIX"
    host, port, prefix, tls = _address("--mqtt-out", url, ("mqtt", "mqtts"), expected, plain=plain)
    if not (prefix or sparkplug) or re.search(_NO_TOPIC, prefix):
        raise AccessError("--mqtt-out", url, f"{expected}, the prefix without + and #")
    address = f"{'mqtts' if tls else 'mqtt'}://{in_url(host)}:{port}"
    options = _broker_options(host, port, credentials, tls=tls)
    client_id, outputs = options["client_id"], []
    if prefix:
        outputs.append(
            OutputSpec("mqtt_out", f"{address}/{prefix}", ("paho",), {"output": "mqtt", "prefix": prefix, **options})
        )
    if sparkplug:
        group, _, node = sparkplug.partition("/")
        if not (group and node) or "/" in node or re.search(_NO_TOPIC, sparkplug):
            raise AccessError("--sparkplug", sparkplug, "GROUP/NODE, without + and #")
        first = {"output": "sparkplug", "group": group, "node": node, **options, "client_id": f"{client_id}_b"}
        outputs.append(OutputSpec("sparkplug", f"{address}/{sparkplug}", ("paho", "google.protobuf"), first))
    return outputs


def influx_out(url: str, credentials: Credentials, *, plain: bool) -> OutputSpec:
    """Return the output to InfluxDB at `http[s]://HOST[:PORT]/ORG/BUCKET`. The errors are those of `mqtt_out`."""
    expected = "http[s]://HOST:PORT/ORG/BUCKET"
    host, port, path, encrypted = _address("--influx", url, ("http", "https"), expected, plain=plain)
    org, _, bucket = path.partition("/")
    if not (org and bucket):
        raise AccessError("--influx", url, expected)
    server = f"{'https' if encrypted else 'http'}://{in_url(host)}:{port}"
    token = credentials.secret("influx", "token_file", "INFLUX_TOKEN")
    if not (token.isascii() and token.isprintable()):  # the message must not contain the token
        raise AccessError("the token of influx", f"{len(token)} characters", "printable ASCII characters only")
    first = {
        "output": "influx",
        "url": server,
        "org": org,
        "bucket": bucket,
        "token": token,
        "ca": credentials.file("influx", "ca"),
    }
    return OutputSpec("influx", f"{server}/{org}/{bucket}", ("influxdb_client",), first)


def opcua_out(url: str, credentials: Credentials, *, plain: bool, acknowledges: bool) -> OutputSpec:
    """Return the OPC UA server that listens on `opc.tcp://HOST:PORT`. The errors are those of `mqtt_out`."""
    expected = "opc.tcp://HOST:PORT"
    files = {key: credentials.file("opcua", key) for key in ("certificate", "key", "trusted")}
    if bool(files["certificate"]) != bool(files["key"]) or (files["trusted"] and not files["key"]):
        raise AccessError("opcua", ", ".join(key for key in files if files[key]), "certificate and key together")
    encrypted = files["certificate"] is not None
    host, port, path, _ = _address("--opcua", url, ("opc.tcp",), expected, plain=True)
    if path:
        raise AccessError("--opcua", url, expected)
    if not (encrypted or plain or is_loopback(host)):
        raise AccessError("--opcua", url, "certificate and key in --out-access for other machines, or --plain")
    address = f"opc.tcp://{in_url(host)}:{port}"
    first = {
        "output": "opcua",
        "endpoint": address,
        "user": credentials.text("opcua", "user"),
        "password": credentials.secret("opcua", "password_file", "OPCUA_OUT_PASSWORD"),
        "acknowledges": acknowledges,
        **files,
    }
    return OutputSpec("opcua_out", address, ("asyncua",), first, may_acknowledge=acknowledges)


def _broker_options(host: str, port: int, credentials: Credentials, *, tls: bool) -> dict[str, Any]:
    files = {key: credentials.file("mqtt", key) for key in ("ca", "certificate", "key")}
    return {
        "host": host,
        "port": port,
        "client_id": credentials.text("mqtt", "client_id", "plow_twin_out"),
        "user": credentials.text("mqtt", "user"),
        "password": credentials.secret("mqtt", "password_file", "MQTT_OUT_PASSWORD"),
        "tls": files if tls else None,
    }


def _address(
    option: str, url: str, schemes: tuple[str, ...], expected: str, *, plain: bool
) -> tuple[str, int, str, bool]:
    """Return host, port and path of an address, and whether its scheme is the last of `schemes`, which is encrypted."""
    try:
        parts = urlsplit(url)
        port = parts.port or _PORTS.get(parts.scheme, 0)
    except ValueError as error:
        raise AccessError(option, url, expected) from error
    if parts.username or parts.password:
        raise AccessError(option, f"{parts.scheme}://...", f"{expected}, user and password in --out-access")
    if parts.scheme not in schemes or parts.query or parts.fragment:
        raise AccessError(option, url, expected)
    host, encrypted = parts.hostname or "localhost", parts.scheme == schemes[-1]
    if not (encrypted or plain or is_loopback(host)):
        raise AccessError(option, url, f"{schemes[-1]}:// for another machine, or --plain")
    return host, port, parts.path.strip("/"), encrypted
