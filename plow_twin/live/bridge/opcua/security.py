"""Encrypt a connection to an OPC UA server, and check the certificate of the server."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from asyncua import ua
from asyncua.client.client import Client
from asyncua.crypto import security_policies
from asyncua.crypto.uacrypto import CertProperties, load_private_key
from cryptography import x509
from cryptography.exceptions import InvalidSignature

from plow_twin.access import key_format
from plow_twin.live.bridge.access import Access
from plow_twin.live.bridge.source import BridgeError

#: Accepted security policies, beginning with the strongest policy.
_POLICIES: Final = (
    security_policies.SecurityPolicyAes256Sha256RsaPss,
    security_policies.SecurityPolicyAes128Sha256RsaOaep,
    security_policies.SecurityPolicyBasic256Sha256,
)
_MODE: Final = ua.MessageSecurityMode.SignAndEncrypt


async def secure(client: Client, access: Access, host: str) -> None:
    """Configure a client to sign and encrypt messages by the strongest policy that the server offers.

    Raise `BridgeError` if the server offers no encryption, its certificate is not trusted, or a file cannot be read.
    """
    assert access.certificate and access.key and access.ca, "checked with the address"
    endpoints = await client.connect_and_get_server_endpoints()
    offered = {end.SecurityPolicyUri: end for end in endpoints if end.SecurityMode == _MODE}
    policy = next((policy for policy in _POLICIES if policy.URI in offered), None)
    if policy is None:
        expected = ", ".join(policy.URI.rpartition("#")[2] for policy in _POLICIES)
        raise BridgeError(f"{access.url}: got a server that offers no encryption, expected one of {expected}")
    server = _first(offered[policy.URI].ServerCertificate)
    _check_trust(x509.load_der_x509_certificate(server), read_certificate(access.ca), host, access)
    own = read_certificate(access.certificate)
    client.application_uri = application_uri(own) or client.application_uri
    try:
        key = await load_private_key(access.key, extension=_format(access.key))
        if key.public_key() != own.public_key():  # the server would not answer
            raise ValueError("the key does not belong to the certificate")
        await client.set_security(
            policy,
            CertProperties(str(access.certificate), _format(access.certificate)),
            CertProperties(str(access.key), _format(access.key)),
            server_certificate=CertProperties(server, "der"),
            mode=_MODE,
        )
    except (OSError, ValueError, TypeError) as error:
        raise BridgeError(f"{access.url}: the files of certificate and key cannot be used: {error}") from error


async def identify(client: Client, access: Access) -> None:
    """Configure a client to log in with the certificate of a user."""
    certificate, key = access.user_certificate, access.user_key
    assert certificate and key, "checked with the address"
    try:
        await client.load_client_certificate(str(certificate), _format(certificate))
        await client.load_private_key(key, extension=_format(key))
    except (OSError, ValueError, TypeError) as error:
        raise BridgeError(f"user: --user-cert and --user-key cannot be used: {error}") from error


def _first(chain: bytes) -> bytes:
    """Return the first certificate of a chain in DER encoding, which is the certificate of the server."""
    return chain[: int.from_bytes(chain[2:4], "big") + 4]


def _format(path: Path) -> str:
    return key_format(path.read_bytes())


def read_certificate(path: Path) -> x509.Certificate:
    """Return the certificate in a file. Raise `BridgeError` if the file contains none."""
    try:
        data = path.read_bytes()
        return (
            x509.load_pem_x509_certificate(data) if key_format(data) == "pem" else x509.load_der_x509_certificate(data)
        )
    except (OSError, ValueError) as error:
        raise BridgeError(f"{path}: got no certificate, expected PEM or DER: {error}") from error


def _check_trust(server: x509.Certificate, trusted: x509.Certificate, host: str, access: Access) -> None:
    """Raise a `BridgeError` unless the certificate is `trusted` itself, or `trusted` issued it for the host."""
    begin, end = server.not_valid_before_utc, server.not_valid_after_utc
    if not begin <= datetime.now(UTC) <= end:
        raise BridgeError(f"{access.url}: the server's certificate is not valid now, but from {begin} to {end}")
    if server == trusted:
        return
    try:
        server.verify_directly_issued_by(trusted)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise BridgeError(
            f"{access.url}: certificate verify failed: it is neither {access.ca} nor issued by it"
        ) from error
    if host not in _hosts(server):
        raise BridgeError(f"{access.url}: the server's certificate is for {', '.join(_hosts(server))}, not for {host}")


def _names(certificate: x509.Certificate) -> x509.SubjectAlternativeName | None:
    try:
        return certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return None


def _hosts(certificate: x509.Certificate) -> list[str]:
    names = _names(certificate)
    if names is None:
        return []
    addresses = [str(name) for name in names.get_values_for_type(x509.IPAddress)]
    return [*names.get_values_for_type(x509.DNSName), *addresses]


def application_uri(certificate: x509.Certificate) -> str:
    """Return the first URI in a certificate, or an empty string."""
    names = _names(certificate)
    uris = names.get_values_for_type(x509.UniformResourceIdentifier) if names else []
    return uris[0] if uris else ""
