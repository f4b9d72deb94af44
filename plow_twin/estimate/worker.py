"""The sliding estimate in a process of its own, beside whoever takes in the samples and never in his way.

`Worker` is the near side: what it is given it only puts down; a thread hands it on. The far side, `python -m
plow_twin.estimate.worker`, collects it, estimates each window that is due and sends back what was found. A window that
became due while another one was computed gives way to a newer one.
"""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from types import MappingProxyType
from typing import Any, Final

from plow_twin.estimate.answer import Asked, answer
from plow_twin.estimate.estimate import Guess, warm_up
from plow_twin.estimate.measurements import Deviation
from plow_twin.estimate.result import Estimate
from plow_twin.estimate.window import Window, Windows
from plow_twin.model.law_modules import load_laws, loaded_laws
from plow_twin.model.scene import Scene

#: Interval at which what was put down is handed on [s].
_HAND_ON_S: Final = 0.05
#: Most that may wait to be handed on: the far side has stopped reading long before [items].
_MOST_WAITING: Final = 1_000_000
#: How much the far side gives way to all others (`nice`).
_NICE: Final = 10
#: The shortest slice that Linux gives, and the number of the call that asks for it.
_SLICE_NS, _SCHED_SETATTR = 100_000, 314
_STOP_S: Final = 5.0
_ESTIMATE_ALONE: Final = Asked()


def _view(contents: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(contents)


# a scene keeps its marks in a view, which pickle does not know
ForkingPickler.register(MappingProxyType, lambda view: (_view, (dict(view),)))


@dataclass(frozen=True)
class Found:
    """An estimate of one window: its bounds [ns], how many rows it had, what it started from, and what came out.

    wall_s : how long it took; skipped : windows before it that gave way; restarts : times that all began anew before it
    text : all of it as JSON, with `forces` and `forecast` where they were asked for, which `also` has too
    """

    start_ns: int
    end_ns: int
    samples: int
    poses: int
    guess: Guess
    estimate: Estimate
    wall_s: float
    skipped: int
    restarts: int
    text: str = ""
    also: dict[str, Any] = field(default_factory=dict)


class Worker:
    """A process that estimates; `take_load`, `take_pose` and `restart` return at once, `poll` what has been found.

    Parameters
    ----------
    scene : Scene
        The nominal scene.
    windows : Windows
        What forms the windows, nothing in it yet; the process has a copy.
    asked : Asked
        What is wanted beside the estimate.
    """

    def __init__(self, scene: Scene, windows: Windows, asked: Asked = _ESTIMATE_ALONE) -> None:
        near, far = Pipe()
        command = [sys.executable, "-m", "plow_twin.estimate.worker", str(far.fileno()), *loaded_laws()]
        # one thread of linear algebra: it is to take no more than one core
        environment = os.environ | dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            command, pass_fds=[far.fileno()], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=environment
        )
        far.close()
        self._connection = near
        self._connection.send((scene, windows, asked))
        self._waiting: deque[tuple[Any, ...]] = deque()
        self._restarts = 0
        self._closed = threading.Event()
        #: why nothing more is estimated; empty: it is
        self.error = ""
        self._thread = threading.Thread(target=self._hand_on, name="estimate", daemon=True)
        self._thread.start()

    def take_load(self, stamp_ns: int, wrench: tuple[float, ...]) -> None:
        """Take in a sample of the load."""
        self._waiting.append(("load", stamp_ns, wrench))

    def take_pose(self, stamp_ns: int, q: tuple[float, ...], deviation: tuple[float, ...] = ()) -> None:
        """Take in a measured pose, with its deviations where they are known."""
        self._waiting.append(("pose", stamp_ns, q, deviation))

    def take_gaps(self, stamp_ns: int, pairs: tuple[int, ...], gaps: tuple[float, ...]) -> None:
        """Take in measured gaps of the pairs with these numbers."""
        self._waiting.append(("gaps", stamp_ns, pairs, gaps))

    def take_spread(self, deviation: Deviation) -> None:
        """Take in how well the load is known from here on."""
        self._waiting.append(("spread", deviation))

    def restart(self) -> None:
        """Let the windows begin anew."""
        self._restarts += 1
        self._waiting.append(("restart",))

    def poll(self) -> Found | None:
        """Return what has been found since the last call, if anything; what was before a restart is dropped."""
        if self.error:
            return None
        if len(self._waiting) > _MOST_WAITING:
            # the thread may be waiting for the far side to read
            self._process.kill()
            self._fail(f"the estimator did not read for {_MOST_WAITING} samples")
            return None
        try:
            if self._connection.poll():
                found: Found = self._connection.recv()
                return found if found.restarts == self._restarts else None
        except (EOFError, OSError):
            code = self._process.poll()
            if code is not None:  # else it is about to end: the next call says so
                self._fail(f"the estimator ended with code {code}")
        return None

    def _fail(self, error: str) -> None:
        """Estimate nothing more; what comes from now on is not kept."""
        self.error, self._waiting = error, deque(maxlen=0)

    def close(self) -> None:
        """End the process."""
        self._closed.set()
        self._process.terminate()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._thread.join(_STOP_S)
        self._connection.close()

    def _hand_on(self) -> None:
        while not self._closed.wait(_HAND_ON_S):
            taken = self._waiting
            waiting = [taken.popleft() for _ in range(len(taken))]
            if waiting:
                try:
                    self._connection.send(waiting)
                except OSError:  # `poll` says why
                    return


def serve(connection: Connection) -> None:
    """Estimate what comes until the other side is gone."""
    scene, windows, asked = connection.recv()
    warm_up(scene)
    guess: Guess = ()
    skipped = restarts = 0
    while True:
        due: Window | None = None
        while due is None or connection.poll():
            for item in connection.recv():
                if item[0] == "restart":
                    windows.restart()
                    due, guess, restarts = None, (), restarts + 1
                    continue
                formed = take(windows, item)
                if formed is not None:
                    skipped += due is not None
                    due = formed
        begin = time.perf_counter()
        found = answer(scene, due, guess, asked)
        wall_s = time.perf_counter() - begin
        bounds = (due.start_ns, due.end_ns, due.samples, due.poses)
        connection.send(Found(*bounds, guess, found.estimate, wall_s, skipped, restarts, found.text, found.also))
        guess, skipped = found.following, 0


def take(windows: Windows, item: tuple[Any, ...]) -> Window | None:
    """Take in one item as `Worker` sends it; return the window that is due, if one is."""
    kind, *values = item
    if kind == "load":
        return windows.take_load(*values)
    if kind == "pose":
        windows.take_pose(*values)
    elif kind == "gaps":
        windows.take_gaps(*values)
    else:
        windows.take_spread(*values)
    return None


def _take_short_slices() -> None:
    """Ask for slices of 0.1 ms: who is due gets its core at their end (Linux 6.12, x86-64; others give longer ones)."""
    if platform.machine() == "x86_64" and sys.platform == "linux":
        # struct sched_attr: size, policy, flags, nice, priority, runtime [ns], deadline, period
        attributes = struct.pack("IIQiIQQQ", 48, os.SCHED_OTHER, 0, _NICE, 0, _SLICE_NS, 0, 0)
        ctypes.CDLL(None).syscall(_SCHED_SETATTR, 0, attributes, 0)


def main() -> None:
    """Run the far side; the arguments are the descriptor of its end, and modules of contact laws."""
    # Ctrl-C goes to the whole group: the near side decides when this one ends
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(_NICE)
    _take_short_slices()
    load_laws(sys.argv[2:])
    try:
        serve(Connection(int(sys.argv[1])))
    except (EOFError, ConnectionError):
        return


if __name__ == "__main__":
    # what is sent must be of the module as the other side imports it, not of `__main__`
    from plow_twin.estimate import worker

    worker.main()
