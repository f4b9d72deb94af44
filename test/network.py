"""Ports and certificates of the servers that tests start."""

from __future__ import annotations

import socket
import subprocess
from pathlib import Path


def free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return int(server.getsockname()[1])


def make_certificate(folder: Path, name: str, uri: str) -> None:
    """Write the certificate `name.pem` of an OPC UA program, and its key `name.key.pem`."""
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", f"/CN={name}",
         "-addext", f"subjectAltName=DNS:localhost,URI:{uri}",
         "-addext", "keyUsage=digitalSignature,nonRepudiation,keyEncipherment,dataEncipherment,keyCertSign",
         "-addext", "extendedKeyUsage=serverAuth,clientAuth",
         "-keyout", str(folder / f"{name}.key.pem"), "-out", str(folder / f"{name}.pem")],
        check=True, capture_output=True,
    )  # fmt: skip
