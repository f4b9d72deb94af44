"""OPC UA server for the results of the twin, which are read-only variables with a stamp and a status."""

from __future__ import annotations

import hmac
import logging
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

from asyncua import ua
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.truststore import TrustStore
from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions
from asyncua.server.server import Server
from asyncua.server.user_managers import UserManager
from asyncua.ua.status_codes import StatusCodes
from cryptography import x509

from plow_twin.access import key_format
from plow_twin.dashboard.link import Link
from plow_twin.live.bridge.opcua.security import application_uri, read_certificate
from plow_twin.record.times import EPOCH
from plow_twin.telemetry.opcua.conditions import Conditions
from plow_twin.telemetry.opcua.model import Model
from plow_twin.telemetry.output import State, TelemetryError
from plow_twin.telemetry.values import Group, Newest, Value

_POLICIES: Final = [
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
]
_UNKNOWN: Final = ua.StatusCode(StatusCodes.BadWaitingForInitialData)
#: Status of a number that was computed without new samples of the load.
_HELD: Final = ua.StatusCode(StatusCodes.UncertainLastUsableValue)
_GOOD: Final = ua.StatusCode()
_SUFFIXES: Final = (".pem", ".der", ".crt", ".cer")


class OneUser(UserManager):
    """User manager that admits one user or, if the name of the user is empty, all clients."""

    def __init__(self, user: str, password: str) -> None:
        self._user, self._password = user, password

    def get_user(
        self, iserver: Any, username: str | None = None, password: str | None = None, certificate: Any = None
    ) -> User | None:
        """Return a user with read access, or None if the credentials are wrong."""
        pairs = zip((self._user, self._password), (username or "", password or ""), strict=True)
        right = all([hmac.compare_digest(own.encode(), value.encode("utf-8", "replace")) for own, value in pairs])
        return User(UserRole.User, username) if right or not self._user else None


class Trusted(TrustStore):
    """Certificates in a folder, whose format is found in their content. asyncua reads only names with der or pem."""

    async def _load_trust_location(self, location: Path) -> list[x509.Certificate]:
        return [read_certificate(path) for path in sorted(location.iterdir()) if path.suffix.lower() in _SUFFIXES]


class OpcUaServer:
    """Output as an OPC UA server, to which clients connect.

    With a certificate and a key, all connections are signed and encrypted. `trusted` is a folder with the certificates
    of the admitted clients or authorities; with None, all clients are admitted. `user` is the only user; if it is
    empty, clients need no login.
    """

    def __init__(
        self,
        endpoint: str,
        certificate: str | None,
        key: str | None,
        trusted: str | None,
        user: str,
        password: str,
        acknowledges: bool,
    ) -> None:
        self.state = State()
        self._endpoint, self._certificate, self._key, self._trusted = endpoint, certificate, key, trusted
        self._acknowledges = acknowledges
        for name in ("asyncua", "asyncuagds"):  # asyncuagds logs the certificates that it refuses
            logger = logging.getLogger(name)
            logger.addHandler(logging.NullHandler())
            logger.propagate = False
        self._server = Server(user_manager=OneUser(user, password))
        self._tokens: list[type] = [ua.UserNameIdentityToken] if user else [ua.AnonymousIdentityToken]
        self._model = Model(self._server)
        self._conditions = Conditions(self._server, self._model)

    async def open(self, link: Link, newest: Newest) -> None:
        """Create the information model of the machine, and listen."""
        if self._acknowledges:
            self._conditions.acknowledge = lambda: link.send({"do": "acknowledge"})
        server = self._server
        server.iserver.bind_condition_methods = True
        await server.init()
        server.set_endpoint(self._endpoint)
        server.set_server_name("plow_twin")
        server.set_identity_tokens(self._tokens)
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        if self._certificate and self._key:
            await self._encrypt(self._certificate, self._key)
        await self._model.build(newest.groups, newest.facts)
        await self._conditions.build(newest.facts["thresholds"])
        await self.send(newest.groups, newest)
        try:
            await server.start()
        except OSError as error:
            raise TelemetryError(f"{self._endpoint}: cannot listen at this address: {error.strerror}") from error

    async def send(self, changed: dict[str, Group], newest: Newest) -> None:
        """Write the values that have changed."""
        for name, group in changed.items():
            for key, value in group.values.items():
                await self._server.write_attribute_value(self._model.nodes[f"{name}/{key}"], _data(value, group))
            if name == "alarms":
                await self._conditions.update(group)
        self.state.sent += 1

    async def turn(self) -> None:
        """Update the state of the connection. The state is connected if at least one client is connected."""
        listening = self._server.bserver
        self.state.connected = bool(listening is not None and listening.clients)

    async def close(self, patience_s: float) -> None:
        """Stop listening."""
        await self._server.stop()

    async def _encrypt(self, certificate: str, key: str) -> None:
        try:
            data, private = Path(certificate).read_bytes(), Path(key).read_bytes()
            await self._server.load_certificate(data, key_format(data))
            await self._server.load_private_key(private, format=key_format(private))
            loaded, own_key = self._server.iserver.certificate, self._server.iserver.private_key
            assert loaded is not None and own_key is not None
            if own_key.public_key() != loaded.public_key():
                raise ValueError("the key does not belong to the certificate")
            if uri := application_uri(loaded):
                await self._server.set_application_uri(uri)
            if self._trusted:
                store = Trusted([Path(self._trusted)], [])
                await store.load()
                checks = CertificateValidatorOptions.BASIC_VALIDATION | CertificateValidatorOptions.TRUSTED
                validator = CertificateValidator(checks | CertificateValidatorOptions.PEER_CLIENT, store)
                self._server.set_certificate_validator(validator.validate)
        except (OSError, ValueError, TypeError) as error:
            raise TelemetryError(f"{self._endpoint}: the certificates cannot be used: {error}") from error
        self._server.set_security_policy(_POLICIES)


def _data(value: Value, group: Group) -> ua.DataValue:
    stamp = EPOCH + timedelta(seconds=group.time_s) if group.time_s else datetime.now(UTC)
    if value is None:
        return ua.DataValue(ua.Variant(), _UNKNOWN, stamp, datetime.now(UTC))
    kind = ua.VariantType.String if isinstance(value, str) else ua.VariantType.Double
    kind = ua.VariantType.Int32 if isinstance(value, int) else kind
    status = _HELD if group.held and isinstance(value, float) else _GOOD
    return ua.DataValue(ua.Variant(value, kind), status, stamp, datetime.now(UTC))
