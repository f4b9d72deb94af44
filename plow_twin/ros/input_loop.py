"""A thread that reads the input queues when messages arrive, and calls timers of a monotonic clock.

The thread replaces the executors of rclpy, which create a task for each message. The events executor of rclpy runs
timers only when no message is waiting, so its timers may never run if samples arrive at 10 kHz.
"""

from __future__ import annotations

import math
import os
import select
import threading
import time
from collections.abc import Callable
from typing import Any, Final, Protocol

from plow_twin.live.timer import Timer

#: Largest number of messages in a batch. Timers and other threads run between two batches.
_MOST: Final = 200
#: Period at which all queues are read, even if no message was signalled [s].
_LOOK_S: Final = 0.1


class Turns:
    """Fair, reentrant lock. A waiting thread acquires it before the thread that has just released it."""

    def __init__(self) -> None:
        self._inside, self._next = threading.Lock(), threading.Lock()
        self._user, self._depth = 0, 0

    def __enter__(self) -> None:
        me = threading.get_ident()
        if self._user != me:
            with self._next:
                self._inside.acquire()
            self._user = me
        self._depth += 1

    def __exit__(self, *error: object) -> None:
        self._depth -= 1
        if not self._depth:
            self._user = 0
            self._inside.release()


class Queue(Protocol):
    """Queue of messages. The file descriptor `fd` becomes readable when a message has arrived."""

    fd: int

    def pop(self, most: int, *, all_there_are: bool = False) -> tuple[list[Any], bool]:
        """Return messages as described in `InputQueue.pop`."""

    def close(self) -> None:
        """Close the queue."""


class Receiver(Protocol):
    """Receiver of the messages on one or more topics."""

    def receive(self, topic: str, batch: list[Any]) -> None:
        """Process a batch of messages on a topic."""


class InputLoop:
    """Thread that processes the inputs of a node.

    The thread and the thread of the executor use the lock `turns`. An error that ends the thread is stored in the
    attribute `error` and passed to the function `on_error`. The thread calls `on_start` first.
    """

    def __init__(
        self, turns: Turns, on_error: Callable[[Exception], None], on_start: Callable[[], object] = lambda: None
    ) -> None:
        self._turns, self._on_error, self._on_start = turns, on_error, on_start
        self._queues: dict[int, tuple[Queue, Receiver, str]] = {}
        #: timers; `run_timers` does not stop the first timer, which reads all queues
        self._timers = [Timer(_LOOK_S, self._look_at_all)]
        self._active = self._stopped = False
        self._due = 0.0
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        # select() fails with file descriptors above 1023
        self._signs = select.poll()
        self._signs.register(self._wake, select.POLLIN)
        self._thread = threading.Thread(target=self._run, name="plow_twin_inputs", daemon=True)
        self.error: Exception | None = None

    def add(self, queue: Queue, receiver: Receiver, topic: str) -> None:
        """Pass messages from a queue to the receiver. The method `close` of this object closes the queue."""
        with self._turns:
            self._queues[queue.fd] = queue, receiver, topic
            self._signs.register(queue.fd, select.POLLIN)
        self._look_again()

    def every(self, period_s: float, do: Callable[[], float | None]) -> None:
        """Add a timer that calls a function every `period_s` seconds. Timers must be added before `start`."""
        self._timers.append(Timer(period_s, do))

    def start(self) -> None:
        """Start the thread. Its timers are stopped until `run_timers` is called."""
        self._thread.start()

    def run_timers(self, active: bool) -> None:
        """Restart the timers if `active` is true, otherwise stop them."""
        with self._turns:
            for timer in self._timers:
                timer.restart()
            self._active, self._due = active, 0.0
        self._look_again()

    def close(self) -> None:
        """End the thread and close the queues. The caller must not hold the lock."""
        self._stopped = True
        self._look_again()
        if self._thread.is_alive():
            self._thread.join()
        for queue, _, _ in self._queues.values():
            queue.close()
        self._queues.clear()
        os.close(self._wake)

    def flush(self) -> None:
        """Pass all messages in the queues to their receivers."""
        with self._turns:
            for fd in self._queues:
                while self._receive(fd, all_there_are=True):
                    pass

    def _look_again(self) -> None:
        os.eventfd_write(self._wake, 1)

    def _run(self) -> None:
        try:
            self._on_start()
            unfinished: list[int] = []  # queues that may still contain messages
            while not self._stopped:
                pause_s = 0.0 if unfinished else max(0.0, self._due - time.monotonic())
                ready = [fd for fd, _ in self._signs.poll(math.ceil(1e3 * pause_s))]
                if self._wake in ready:
                    os.eventfd_read(self._wake)
                    ready.remove(self._wake)
                if unfinished:
                    ready = list({*unfinished, *ready})
                with self._turns:
                    unfinished = [fd for fd in ready if self._receive(fd)]
                    if time.monotonic() >= self._due:
                        self._look_at_timers()
        except Exception as error:  # any error is reported, because the twin stops when the thread ends
            self.error = error
            self._on_error(error)

    def _receive(self, fd: int, *, all_there_are: bool = False) -> bool:
        queue, receiver, topic = self._queues[fd]
        batch, more = queue.pop(_MOST, all_there_are=all_there_are)
        if batch:
            receiver.receive(topic, batch)
        return more

    def _look_at_timers(self) -> None:
        timers = self._timers if self._active else self._timers[:1]
        for timer in timers:
            timer.look()
        self._due = min(timer.due for timer in timers)

    def _look_at_all(self) -> None:
        for fd in self._queues:
            self._receive(fd, all_there_are=True)
