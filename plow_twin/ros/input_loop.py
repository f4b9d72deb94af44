"""A thread that empties the input queues as messages arrive, and runs timers by a steady clock.

An executor of rclpy makes a task of each message, and the events executor looks at its timers only when no message
waits. At 10 kHz, nothing was published, and 95 % of its tasks found a queue that an earlier task had emptied.
"""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Callable
from typing import Any, Final, Protocol

from plow_twin.live.timer import Timer

#: Largest number of messages taken at once; timers and other threads run between two batches.
_MOST: Final = 200
#: Period at which all queues are read even without a notification [s].
_LOOK_S: Final = 0.1


class Turns:
    """A fair, reentrant lock: a waiting thread gets it before the thread that has just released it."""

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
    """Messages that wait; `fd` becomes readable when a message has arrived."""

    fd: int

    def pop(self, most: int, *, all_there_are: bool = False) -> tuple[list[Any], bool]:
        """As `InputQueue.pop`."""

    def close(self) -> None:
        """Release the queue."""


class Receiver(Protocol):
    """Receives the messages of some topics."""

    def receive(self, topic: str, batch: list[Any]) -> None:
        """Receive the messages that were in the queue of a topic."""


class InputLoop:
    """The thread of a node's inputs.

    It holds `turns`, the lock that keeps it apart from the executor's thread, while it works. `on_error` is called with
    the error that ended the thread, which `error` keeps.
    """

    def __init__(self, turns: Turns, on_error: Callable[[Exception], None]) -> None:
        self._turns, self._on_error = turns, on_error
        self._queues: dict[int, tuple[Queue, Receiver, str]] = {}
        #: the first timer, which looks at all queues, always runs
        self._timers = [Timer(_LOOK_S, self._look_at_all)]
        self._active = self._stopped = False
        self._due = 0.0
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._signs = [self._wake]
        self._thread = threading.Thread(target=self._run, name="plow_twin_inputs", daemon=True)
        self.error: Exception | None = None

    def add(self, queue: Queue, receiver: Receiver, topic: str) -> None:
        """Pass messages from the queue of a topic to its receiver; the loop closes the queue at its end."""
        with self._turns:
            self._queues[queue.fd] = queue, receiver, topic
            self._signs.append(queue.fd)
        self._look_again()

    def every(self, period_s: float, do: Callable[[], float | None]) -> None:
        """Call a function every `period_s` seconds while the timers run; to be called before `start`."""
        self._timers.append(Timer(period_s, do))

    def start(self) -> None:
        """Start the thread with its timers stopped."""
        self._thread.start()

    def run_timers(self, active: bool) -> None:
        """Restart the timers, or stop them."""
        with self._turns:
            for timer in self._timers:
                timer.restart()
            self._active, self._due = active, 0.0
        self._look_again()

    def close(self) -> None:
        """End the thread and close the queues; the caller must not hold the lock."""
        self._stopped = True
        self._look_again()
        if self._thread.is_alive():
            self._thread.join()
        for queue, _, _ in self._queues.values():
            queue.close()
        self._queues.clear()
        os.close(self._wake)

    def flush(self) -> None:
        """Pass on the messages that wait now."""
        with self._turns:
            for fd in self._queues:
                while self._receive(fd, all_there_are=True):
                    pass

    def _look_again(self) -> None:
        os.eventfd_write(self._wake, 1)

    def _run(self) -> None:
        try:
            left: list[int] = []  # queues in which messages may still wait
            while not self._stopped:
                pause_s = 0.0 if left else max(0.0, self._due - time.monotonic())
                ready = select.select(self._signs, (), (), pause_s)[0]
                if self._wake in ready:
                    os.eventfd_read(self._wake)
                    ready.remove(self._wake)
                if left:
                    ready = list({*left, *ready})
                with self._turns:
                    left = [fd for fd in ready if self._receive(fd)]
                    if time.monotonic() >= self._due:
                        self._look_at_timers()
        except Exception as error:  # a thread that ended unnoticed would stop the twin
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
