"""Programs of the package as forks of a process that has already imported them; the imports take over a second.

A fork has the arguments, the environment and the signal handlers of a program that was started normally. Variables that
libraries read during their import have no effect on a fork. A program with other values of such variables is therefore
started normally.
"""

from __future__ import annotations

import atexit
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parent.parent
#: Programs that are forked. Other programs are started, which tests their imports too.
_FORKED = ("plow_twin.ros.main", "plow_twin.demo.excitation_publisher")
#: Variables that are read only after the imports.
_LATE = {"PYTEST_CURRENT_TEST", "ROS_DOMAIN_ID", "ROS_LOG_DIR"}

_PROGRAM = """
import gc, json, os, runpy, select, signal, socket
import plow_twin.cli.live, plow_twin.live.front, plow_twin.record.recorder, plow_twin.ros.node
import plow_twin.demo.excitation_publisher

def serve(orders):
    handler, places = signal.signal(signal.SIGINT, signal.SIG_IGN), {}
    ended, wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake)
    gc.freeze()
    while True:
        ready, _, _ = select.select([orders, ended], [], [])
        if ended in ready:
            os.read(ended, 4096)
        while places:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                break
            os.write(places[pid], b"%d" % os.waitstatus_to_exitcode(status))
            os.close(places.pop(pid))
        if orders not in ready:
            continue
        text, given, _, _ = socket.recv_fds(orders, 1 << 20, 2)
        if not text:
            os._exit(0)
        pid = os.fork()
        if pid:
            os.close(given[0])
            places[pid] = given[1]
            orders.send(b"%d" % pid)
            continue
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.signal(signal.SIGINT, handler)
        for place in (1, 2):
            os.dup2(given[0], place)
        for place in (*given, ended, wake, *places.values()):
            os.close(place)
        orders.close()
        return json.loads(text)

name, arguments, environment = serve(socket.socket(fileno=int(os.environ.pop("FORGE_ORDERS"))))
os.environ.clear()
os.environ.update(environment)
import sys
sys.argv[1:] = arguments
sys.modules.pop(name, None)
runpy.run_module(name, run_name="__main__", alter_sys=True)
"""


def _environment() -> dict[str, str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    return environment | {"AMENT_PREFIX_PATH": environment.get("AMENT_PREFIX_PATH") or sys.prefix}


#: Environment at the time of the imports, before tests change variables.
_KNOWN = _environment()


@cache
def _orders() -> socket.socket:
    """Start the forking process of this test process. Return the socket for its commands."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    process = subprocess.Popen(
        [sys.executable, "-c", _PROGRAM], env=_KNOWN | {"FORGE_ORDERS": str(theirs.fileno())},
        pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL,
    )  # fmt: skip
    theirs.close()

    def end() -> None:
        ours.close()
        process.wait(10.0)

    atexit.register(end)
    return ours


class Fork:
    """A program in a fork, with the interface of `subprocess.Popen`."""

    def __init__(self, module: str, arguments: Sequence[str], output: IO[bytes]) -> None:
        orders = _orders()
        self._end, their_end = os.pipe()
        text = json.dumps([module, arguments, _environment()]).encode()
        socket.send_fds(orders, [text], [output.fileno(), their_end])
        os.close(their_end)
        self.pid = int(orders.recv(64))
        self.returncode: int | None = None

    def poll(self) -> int | None:
        return self._ended(0.0)

    def wait(self, timeout: float | None = None) -> int:
        code = self._ended(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
        return code

    def _ended(self, timeout: float | None) -> int | None:
        if self.returncode is None and select.select([self._end], [], [], timeout)[0]:
            self.returncode = int(os.read(self._end, 64) or b"-9")  # a killed forking process writes no exit code
            os.close(self._end)
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with suppress(ProcessLookupError):  # the program has ended, but its exit code has not been written yet
                os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def start(module: str, arguments: Sequence[str], output: IO[bytes]) -> Fork | subprocess.Popen[bytes]:
    """Start a program. Fork it if it is one of `_FORKED` and all variables that imports may read are unchanged."""
    environment = _environment()
    if module in _FORKED and {name for name, _ in environment.items() ^ _KNOWN.items()} <= _LATE:
        return Fork(module, arguments, output)
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.Popen(command, env=environment, stdout=output, stderr=subprocess.STDOUT)
