"""End a verb in bounded time after a signal, even if the code of a library is waiting."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from plow_twin.live.stop import stop_signals

#: Time after a signal in which a verb must end [s].
PATIENCE_S: Final = 3.0


@contextmanager
def interruptible(on_overdue: Callable[[], object] = lambda: None) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether a stop signal has arrived.

    If the context has not ended `PATIENCE_S` seconds after the signal, because a library is waiting, `on_overdue` is
    called and the process ends with exit code 1.
    """
    interrupted, done = threading.Event(), threading.Event()
    receive, send = os.pipe()
    os.set_blocking(send, False)

    def watch() -> None:
        # a signal writes a byte to the pipe, which wakes this thread even if the main thread is blocked
        os.read(receive, 1)
        interrupted.set()
        if not done.wait(PATIENCE_S):
            on_overdue()
            os._exit(1)

    before = {number: signal.signal(number, lambda *_: None) for number in stop_signals()}
    wakeup = signal.set_wakeup_fd(send)
    thread = threading.Thread(target=watch, daemon=True, name="plow_twin interruption")
    thread.start()
    try:
        yield interrupted.is_set
    finally:
        done.set()
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.write(send, b"\0")
        thread.join()
        os.close(send)
        os.close(receive)
