"""Analysis of many recordings on several cores or on a Dask cluster."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.connection import wait
from typing import Any

from plow_twin.model.law_modules import load_laws, loaded_laws
from plow_twin.study.analysis.task import RunTask, run_task
from plow_twin.study.cluster import completed, connect

#: Callback that receives the share of the recordings done, 0..1.
OnProgress = Callable[[float], object]
_OnDone = Callable[[int, dict[str, Any]], object]


def run_many(
    tasks: Sequence[RunTask], *, workers: int, dask: str | None = None, on_progress: OnProgress = lambda share: None
) -> list[dict[str, Any]]:
    """Return the result of each task, or a mapping with the key `error` if the task failed.

    A task with a stored result does not run. The tasks run in `workers` processes, or on the Dask cluster with the
    scheduler at `dask`. The workers of the cluster must have access to the same files. Raise `StudyError` if the
    cluster cannot be reached, or has no worker.
    """
    results = {number: facts for number, task in enumerate(tasks) if (facts := task.stored()) is not None}

    def done(number: int, facts: dict[str, Any]) -> None:
        results[number] = facts
        on_progress(len(results) / len(tasks))

    waiting = [number for number in range(len(tasks)) if number not in results]
    if waiting and dask is not None:
        _on_cluster(tasks, waiting, dask, done)
    elif waiting:
        _here(tasks, waiting, workers, done)
    return [results[number] for number in range(len(tasks))]


def _here(tasks: Sequence[RunTask], waiting: list[int], workers: int, done: _OnDone) -> None:
    while waiting:
        remaining = _round(tasks, waiting, workers, done)
        # a task has killed its worker, so the first tasks run one at a time until this task is found
        if len(remaining) == len(waiting):
            remaining, first = remaining[workers:], remaining[:workers]
            for number in first:
                if _round(tasks, [number], 1, done):
                    done(number, {"run": str(tasks[number].path), "error": "the worker was killed, twice"})
        waiting = remaining


def _round(tasks: Sequence[RunTask], waiting: list[int], workers: int, done: _OnDone) -> list[int]:
    """Run the waiting tasks once. Return the tasks that are unfinished because their worker died."""
    remaining = []
    others = active_children()
    pool = ProcessPoolExecutor(min(workers, len(waiting)), get_context("spawn"), _begin, (loaded_laws(),))
    try:
        futures = {pool.submit(run_task, tasks[number]): number for number in waiting}
        for future in as_completed(futures):
            try:
                done(futures[future], future.result())
            except BrokenProcessPool:
                remaining.append(futures[future])
    except BaseException:  # the next call repeats unfinished analyses
        for worker in set(active_children()).difference(others):
            worker.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
    return sorted(remaining)


def _begin(laws: tuple[str, ...]) -> None:
    _belong_to_the_caller()
    load_laws(laws)


def _belong_to_the_caller() -> None:
    """Ignore interrupts, which the calling process handles, and end this process when the calling process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    assert parent is not None

    def follow() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True, name="plow_twin caller").start()


def _on_cluster(tasks: Sequence[RunTask], waiting: list[int], address: str, done: _OnDone) -> None:
    with connect(address) as client:
        futures = {client.submit(run_task, tasks[number], pure=False, retries=2): number for number in waiting}
        for future in completed(client, futures):
            number = futures[future]
            try:
                done(number, future.result())
            except Exception as error:  # a worker can raise any error
                path = str(tasks[number].path)
                done(number, {"run": path, "error": f"{path}: {type(error).__name__}: {error}"})
