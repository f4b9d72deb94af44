"""Connection to a Dask cluster."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, Final

from plow_twin.study.parameters import StudyError

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_TIMEOUT_S = 20.0
#: Longest time [s] that the cluster may have no worker.
WORKER_TIMEOUT_S = 300.0
#: Interval [s] of the checks for workers while no result arrives.
_LOOK_S: Final = 2.0


def connect(address: str) -> Client:
    """Return a client of the scheduler at `address`, or raise a `StudyError` if the scheduler does not answer."""
    from distributed import Client
    from distributed.comm.addressing import parse_address
    from distributed.comm.registry import get_backend

    try:
        # a client with a wrong address waits 40 s at the end of the process, and then prints a traceback
        scheme, place = parse_address(address)
        get_backend(scheme).get_address_host(place)  # type: ignore[no-untyped-call]
        return Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as error:
        raise StudyError(f"dask: got {address!r}, expected the address of a scheduler ({error})") from None


def completed(client: Client, futures: Iterable[Future[Any]]) -> Iterator[Future[Any]]:
    """Yield futures in order of completion.

    Raises a `StudyError` if the cluster has no worker for `WORKER_TIMEOUT_S`.
    """
    from distributed import as_completed

    waiting: set[Any] = set(futures)
    workers_seen = time.monotonic()
    while waiting:
        try:
            for future in as_completed(  # type: ignore[no-untyped-call]
                list(waiting), loop=client.loop, timeout=_LOOK_S
            ):
                waiting.remove(future)
                workers_seen = time.monotonic()
                yield future
        except TimeoutError:
            now = time.monotonic()
            workers_seen = now if client.scheduler_info()["workers"] else workers_seen
            if now - workers_seen > WORKER_TIMEOUT_S:
                got = f"got no worker for {WORKER_TIMEOUT_S:g} s, expected at least one"
                raise StudyError(
                    f"dask: {got}; finished chunks are stored, and the same command computes the rest"
                ) from None
