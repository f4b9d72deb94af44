"""End of a verb by a signal in bounded time, even while it waits in the code of a library."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from plow_twin.live.stop import stop_signals

#: Time that an interrupted verb has to end by itself [s].
PATIENCE_S: Final = 3.0


@contextmanager
def interruptible(on_overdue: Callable[[], object] = lambda: None) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether the process was asked to end.

    If the block has not ended after `PATIENCE_S`, `on_overdue` is called and the process ends with exit code 1, because
    a library that waits for a viewer cannot be interrupted in another way.
    """
    asked, done = threading.Event(), threading.Event()
    receive, send = os.pipe()
    os.set_blocking(send, False)

    def watch() -> None:
        # the handler of a signal writes a byte, for which this thread waits apart from the main thread
        os.read(receive, 1)
        asked.set()
        if not done.wait(PATIENCE_S):
            on_overdue()
            os._exit(1)

    before = {number: signal.signal(number, lambda *_: None) for number in stop_signals()}
    wakeup = signal.set_wakeup_fd(send)
    thread = threading.Thread(target=watch, daemon=True, name="plow_twin interruption")
    thread.start()
    try:
        yield asked.is_set
    finally:
        done.set()
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.write(send, b"\0")
        thread.join()
        os.close(send)
        os.close(receive)
