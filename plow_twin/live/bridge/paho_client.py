"""MQTT clients for paho 1.6 and paho 2, whose callbacks have different arguments."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import Any, Final

#: Longest interval between two attempts to connect [s].
LONGEST_WAIT_S: Final = 30
#: Smallest reason code of a refused subscription in paho 1.6.
_REFUSED: Final = 0x80


def make_client(client_id: str, *, clean: bool) -> Any:
    """Return a client of MQTT 3.1.1 that reconnects automatically. With `clean`, the session is not persistent."""
    from paho.mqtt import client as paho

    interface = getattr(paho, "CallbackAPIVersion", None)  # this attribute exists in paho 2.0 and later
    make: Any = paho.Client
    version = () if interface is None else (interface.VERSION2,)
    client = make(*version, client_id, clean_session=clean, protocol=paho.MQTTv311)
    client.reconnect_delay_set(1, LONGEST_WAIT_S)
    return client


def use_tls(client: Any, ca: Path | str | None, certificate: Path | str | None, key: Path | str | None) -> None:
    """Configure a client to use TLS, and to check the certificate and the name of the broker.

    The certificate is checked with the authority in `ca` or, if `ca` is None, with the authorities of the system. Raise
    `OSError` or `ValueError` if a file cannot be read or is invalid.
    """
    if key and not certificate:
        raise ValueError("got a key without its certificate")
    context = ssl.create_default_context(cafile=ca)
    if certificate:
        context.load_cert_chain(certificate, key)
    client.tls_set_context(context)


def is_resumed(flags: Any) -> bool:
    """Return whether the broker has resumed the session. `flags` is the argument of the callback `on_connect`."""
    session_present = flags["session present"] if isinstance(flags, dict) else flags.session_present
    return bool(session_present)


def refusal(reason: Any) -> str:
    """Return the reason why a connection was refused, or an empty string if it was accepted."""
    if isinstance(reason, int):
        from paho.mqtt.client import connack_string

        return str(connack_string(reason)) if reason else ""
    return str(reason) if reason.is_failure else ""


def subscription_refusal(reason: Any) -> str:
    """Return the reason why a subscription was refused, or an empty string if it was accepted."""
    if isinstance(reason, int):
        return "not authorized, or no such topic" if reason >= _REFUSED else ""
    return str(reason) if reason.is_failure else ""


def end_of(*facts: Any) -> str:
    """Return the reason why a connection ended. `facts` are the last arguments of the callback `on_disconnect`."""
    if len(facts) == 1:
        from paho.mqtt.client import error_string

        return str(error_string(facts[0]))
    return str(facts[1])
