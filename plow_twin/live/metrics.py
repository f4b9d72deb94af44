"""Serve the diagnostics of a live twin as metrics for Prometheus."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, Self

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import GaugeMetricFamily

from plow_twin.errors import PlowTwinError
from plow_twin.live.part import Part, number_of

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric

    from plow_twin.stream.outputs import Published

_OTHER: Final = re.compile(r"[^a-zA-Z0-9_]")
_READERS: Final = 16
_PATIENCE_S: Final = 10.0


class MetricsError(PlowTwinError):
    """The port cannot be used."""


class Metrics:
    """Context manager that serves the page `http://127.0.0.1:PORT/metrics`, which Prometheus reads.

    The page shows `parts` until the twin sends reports. Each number in the last report is a gauge with the name
    `plow_twin_<part>_<key>`. Texts in the report are omitted.
    """

    def __init__(self, port: int, parts: Mapping[str, Part]) -> None:
        self._parts = parts
        registry = CollectorRegistry()
        registry.register(self)
        try:
            self._server, self._thread = start_http_server(port, "127.0.0.1", registry)
        except (OSError, OverflowError) as error:
            raise MetricsError(f"port {port} for metrics cannot be used: {error}") from error
        _bound(self._server)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def publication(self, published: Published) -> None:
        """Do nothing, because the diagnostics contain no motion."""

    def part(self, name: str, part: Part) -> None:
        """Replace a part of the diagnostics."""
        self._parts = {**self._parts, name: part}

    def collect(self) -> Iterator[Metric]:
        """Yield a gauge for each number."""
        for name, (level, _, values) in self._parts.items():
            yield _gauge(f"{name}_level", "0 OK, 1 warning, 2 error", float(level))
            for key, text in values.items():
                number = number_of(text)
                if number is not None:
                    yield _gauge(f"{name}_{key}", f"{key} of the part {name} of the diagnostics", number)


def _bound(server: Any) -> None:
    """Limit the number of simultaneous readers, each of which takes a thread, and disconnect silent readers."""
    free = threading.BoundedSemaphore(_READERS)
    start, serve = server.process_request, server.process_request_thread
    handler = server.RequestHandlerClass
    server.RequestHandlerClass = type("Handler", (handler,), {"timeout": _PATIENCE_S})

    def admit(request: socket.socket, address: Any) -> None:
        if free.acquire(blocking=False):
            start(request, address)
        else:
            server.shutdown_request(request)

    def answer(request: socket.socket, address: Any) -> None:
        try:
            serve(request, address)
        finally:
            free.release()

    server.process_request, server.process_request_thread = admit, answer


def _gauge(name: str, meaning: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"plow_twin_{_OTHER.sub('_', name)}", meaning, value)
