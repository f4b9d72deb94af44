"""Computation of the missing chunks of a sweep, on this machine or on a Dask cluster."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plow_twin.build import build_fingerprint
from plow_twin.study.cluster import completed, connect
from plow_twin.study.parameters import StudyError
from plow_twin.study.store import Store
from plow_twin.study.sweep.table import Sweep, Table, run_members_of

Array = NDArray[np.float64]
OnProgress = Callable[[int], object]  # callback that receives the number of finished members


def run_here(store: Store, workers: int | None = None, on_progress: OnProgress = lambda count: None) -> Table:
    """Compute and store the missing chunks with threads of this process. Return the whole table."""
    chunks, missing = store.chunks, store.missing()
    done = store.sweep.size - sum(len(chunks[index]) for index in missing)
    build = _build()
    for index in missing:

        def report(count: int, before: int = done) -> None:
            on_progress(before + count)

        store.write(index, run_members_of(store.sweep, chunks[index], workers, report), build)
        done += len(chunks[index])
        on_progress(done)
    return store.table()


def run_on_cluster(store: Store, address: str, on_progress: OnProgress = lambda count: None) -> Table:
    """Compute the missing chunks on the Dask cluster at `address`. Return the whole table.

    Each chunk is one task, and its result is stored on arrival. If a worker dies, the scheduler assigns its tasks to
    another worker. Raise `StudyError` if the cluster cannot be reached, has no worker, or gives up a task.
    """
    chunks, missing = store.chunks, store.missing()
    done = store.sweep.size - sum(len(chunks[index]) for index in missing)
    if not missing:
        return store.table()
    with connect(address) as client:
        futures: dict[Any, int] = {
            client.submit(_task, store.sweep, list(chunks[index]), pure=False, retries=2): index for index in missing
        }
        for future in completed(client, futures):
            index = futures[future]
            try:
                table, build = future.result()
            except Exception as error:
                # a worker can raise any error; the next call continues with the stored chunks
                raise StudyError(f"dask: chunk {index}: {type(error).__name__}: {error}") from error
            store.write(index, table, build)
            done += len(chunks[index])
            on_progress(done)
    return store.table()


def _task(sweep: Sweep, members: list[int]) -> tuple[Array, str]:
    """Compute a chunk with one thread, because each thread of a worker runs a task."""
    return run_members_of(sweep, members, workers=1), _build()


def _build() -> str:
    return json.dumps(dict(build_fingerprint()), sort_keys=True)
