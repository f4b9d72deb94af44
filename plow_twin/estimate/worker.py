"""The sliding estimate in a process of its own, so that it does not delay the samples of the twin.

The class `Worker` runs in the process of the twin, the *near side*. It queues data, which a thread sends to the *far
side*, the process `python -m plow_twin.estimate.worker`. The far side compiles its kernels, reports that it is ready,
and sends back the estimate of each window that is due. Of several windows that become due during an estimate, only the
newest is estimated.
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

from plow_twin.estimate.answer import Requests, answer
from plow_twin.estimate.estimate import Guess, warm_up
from plow_twin.estimate.forces import TOLERANCE
from plow_twin.estimate.measurements import Deviation
from plow_twin.estimate.members import compile_friction, rubs
from plow_twin.estimate.result import Estimate
from plow_twin.estimate.window import Window, Windows
from plow_twin.model.law_modules import load_laws, loaded_laws
from plow_twin.model.scene import Scene

#: Upper bound on the interval at which queued data are sent [s].
_SEND_S: Final = 0.05
#: Upper bound on the number of queued items, if the far side has stopped reading.
_MOST_WAITING: Final = 1_000_000
#: `nice` value of the far side, a bound on its effect on the twin.
_NICE: Final = 10
#: Shortest time slice in ns, and number of the system call `sched_setattr`, by definition of Linux.
_SLICE_NS, _SCHED_SETATTR = 100_000, 314
#: Upper bound on the time in s until the far side has ended.
_STOP_S: Final = 5.0
_ESTIMATE_ALONE: Final = Requests()


def _view(contents: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(contents)


# a scene contains mapping proxies, which `pickle` does not support
ForkingPickler.register(MappingProxyType, lambda view: (_view, (dict(view),)))


@dataclass(frozen=True)
class WindowResult:
    """Result of the estimate of one window.

    start_ns : beginning of the window [ns]
    end_ns : end of the window [ns]
    samples : number of load samples in the window
    poses : number of poses in the window
    guess : first guess of the fit
    estimate : the estimate
    wall_s : duration of the computation in s
    skipped : number of windows that were skipped before this window
    restarts : number of restarts before this window
    text : the whole answer as JSON, with `forces` and `forecast` if requested
    also : the answers `forces` and `forecast` as JSON values, if requested
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
    """A process that computes estimates; all methods except `close` return at once.

    Parameters
    ----------
    scene : Scene
        The nominal scene.
    windows : Windows
        The empty object that forms the windows in the process.
    requests : Requests
        The answers that are requested in addition to the estimate.
    """

    def __init__(self, scene: Scene, windows: Windows, requests: Requests = _ESTIMATE_ALONE) -> None:
        near, far = Pipe()
        command = [sys.executable, "-m", "plow_twin.estimate.worker", str(far.fileno()), *loaded_laws()]
        # the far side uses at most one core
        environment = os.environ | dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            command, pass_fds=[far.fileno()], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=environment
        )
        far.close()
        self._connection = near
        self._connection.send((scene, windows, requests))
        self._waiting: deque[tuple[Any, ...]] = deque()
        self._restarts = 0
        #: whether the far side has compiled its kernels
        self.ready = False
        self._closed = threading.Event()
        #: reason why the process has ended; empty while it runs
        self.error = ""
        #: None until the estimate that `finish` requests has ended; then the reason of a failure, or an empty text
        self.ended: str | None = None
        self._thread = threading.Thread(target=self._send_queue, name="estimate", daemon=True)
        self._thread.start()

    def add_load(self, stamp_ns: int, wrench: tuple[float, ...]) -> None:
        """Queue a sample of the load."""
        self._waiting.append(("load", stamp_ns, wrench))

    def add_pose(self, stamp_ns: int, q: tuple[float, ...], deviation: tuple[float, ...] = ()) -> None:
        """Queue a measured pose and its standard deviations, if known."""
        self._waiting.append(("pose", stamp_ns, q, deviation))

    def add_gaps(self, stamp_ns: int, pairs: tuple[int, ...], gaps: tuple[float, ...]) -> None:
        """Queue measured gaps in m of the pairs with the indices `pairs`."""
        self._waiting.append(("gaps", stamp_ns, pairs, gaps))

    def set_load_deviation(self, deviation: Deviation) -> None:
        """Queue the standard deviation of the load that applies from now on."""
        self._waiting.append(("spread", deviation))

    def restart(self) -> None:
        """Drop all data and begin new windows."""
        self._restarts += 1
        self._waiting.append(("restart",))

    def finish(self) -> None:
        """Request the estimate of the last window after the end of the input; `ended` is None until the result."""
        self._waiting.append(("end",))

    @property
    def behind(self) -> bool:
        """Whether the queue of unsent data is more than a tenth full."""
        return len(self._waiting) > _MOST_WAITING // 10

    def poll(self) -> WindowResult | None:
        """Return the next result, or None if none has arrived. Results of windows before a restart are dropped."""
        if self.error or self.ended is not None:
            return None
        if len(self._waiting) > _MOST_WAITING:
            # the far side does not read, which may block the sending thread
            self._process.kill()
            self._fail(f"the estimator did not read for {_MOST_WAITING} samples")
            return None
        try:
            if self._connection.poll():
                reply: WindowResult | str | None = self._connection.recv()
                if reply is None:
                    self.ready = True
                    return None
                if isinstance(reply, str):
                    self.ended = reply
                    return None
                return reply if reply.restarts == self._restarts else None
        except (EOFError, OSError):
            code = self._process.poll()
            if code is not None:  # None while the process is ending
                self._fail(f"the estimator ended with code {code}")
        return None

    def _fail(self, error: str) -> None:
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

    def _send_queue(self) -> None:
        while not self._closed.wait(_SEND_S):
            queue = self._waiting
            waiting = [queue.popleft() for _ in range(len(queue))]
            if waiting:
                try:
                    self._connection.send(waiting)
                except OSError:  # `poll` reports the cause
                    return


def serve(connection: Connection) -> None:
    """Receive data and send estimates until the near side closes the connection."""
    scene, windows, requests = connection.recv()
    warm_up(scene)
    connection.send(None)  # the kernels are compiled
    guess: Guess = ()
    ended: str | None = None
    skipped = restarts = 0
    compiled = False
    while True:
        due: Window | None = None
        while ended is None and (due is None or connection.poll()):
            for item in connection.recv():
                if item[0] == "restart":
                    windows.restart()
                    due, guess, restarts = None, (), restarts + 1
                    continue
                formed = windows.last() if item[0] == "end" else add(windows, item)
                if item[0] == "end":
                    ended = formed if isinstance(formed, str) else ""
                if isinstance(formed, Window):
                    skipped += due is not None
                    due = formed
        if due is None:
            connection.send(ended)
            connection.recv()  # raises `EOFError` when the near side closes the connection
        assert due is not None
        begin = time.perf_counter()
        reply = answer(scene, due, guess, requests)
        wall_s = time.perf_counter() - begin
        if requests.follows and not compiled and rubs(scene, reply.estimate):
            # the process of the twin then loads these kernels from the cache
            compile_friction(scene, TOLERANCE)
            compiled = True
        bounds = (due.start_ns, due.end_ns, due.samples, due.poses)
        connection.send(WindowResult(*bounds, guess, reply.estimate, wall_s, skipped, restarts, reply.text, reply.also))
        guess, skipped = reply.following, 0


def add(windows: Windows, item: tuple[Any, ...]) -> Window | None:
    """Add a queued item of `Worker` to the windows; return a window if one has become due."""
    kind, *values = item
    if kind == "load":
        return windows.add_load(*values)
    if kind == "pose":
        return windows.add_pose(*values)
    if kind == "gaps":
        windows.add_gaps(*values)
    else:
        windows.set_load_deviation(*values)
    return None


def _request_short_slices() -> None:
    """Request time slices of 0.1 ms, so that the twin waits less for the core (x86-64, Linux 6.12 or newer)."""
    if platform.machine() == "x86_64" and sys.platform == "linux":
        # struct sched_attr: size, policy, flags, nice, priority, runtime [ns], deadline, period
        attributes = struct.pack("IIQiIQQQ", 48, os.SCHED_OTHER, 0, _NICE, 0, _SLICE_NS, 0, 0)
        ctypes.CDLL(None).syscall(_SCHED_SETATTR, 0, attributes, 0)


def main() -> None:
    """Run the far side. `sys.argv` contains the pipe's descriptor and the names of modules with contact laws."""
    # Ctrl-C sends SIGINT to the whole process group, but only the near side ends the far side
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(_NICE)
    _request_short_slices()
    load_laws(sys.argv[2:])
    try:
        serve(Connection(int(sys.argv[1])))
    except (EOFError, ConnectionError):
        return


if __name__ == "__main__":
    # pickled classes must belong to the imported module, not to `__main__`
    from plow_twin.estimate import worker

    worker.main()
