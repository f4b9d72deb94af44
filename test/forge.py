"""Programs of the package as forks of a process that has already imported them; the imports take over a second.

A fork has the arguments, the streams, the environment and the signal handlers of a program that was started normally.
Variables that libraries read during their import have no effect on a fork. A program with other values of such
variables is therefore started normally.
"""

from __future__ import annotations

import atexit
import json
import os
import select
import socket
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
#: Programs that are forked. Other programs are started, which tests their imports too.
_FORKED = ("plow_twin", "plow_twin.ros.main", "plow_twin.demo.excitation_publisher")
#: Arguments of commands that use ROS. A fork of such a command may crash at its end, so these commands are started.
_WITH_ROS = {"record", "telemetry", "demo", "--ros"}
#: Variables that are read only after the imports.
_LATE = {"PYTEST_CURRENT_TEST", "ROS_DOMAIN_ID", "ROS_LOG_DIR"}

_PROGRAM = f"""
import gc, json, os, runpy, select, signal, socket, sys
sys.path.insert(0, {str(ROOT / "test")!r})
from shared_work import compile_once
del sys.path[0]
compile_once()
"""
_PROGRAM += """
import plow_twin.cli.live, plow_twin.live.front, plow_twin.record.recorder, plow_twin.record.replay, plow_twin.ros.node
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
        text, given, _, _ = socket.recv_fds(orders, 1 << 20, 4)
        if not text:
            os._exit(0)
        pid = os.fork()
        if pid:
            for place in given[:3]:
                os.close(place)
            places[pid] = given[3]
            orders.send(b"%d" % pid)
            continue
        signal.set_wakeup_fd(-1)
        for number in (signal.SIGCHLD, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, handler)
        for place in range(3):
            os.dup2(given[place], place)
        for place in (*given, ended, wake, *places.values()):
            os.close(place)
        orders.close()
        return json.loads(text)

name, arguments, environment, folder = serve(socket.socket(fileno=int(os.environ.pop("FORGE_ORDERS"))))
os.environ.clear()
os.environ.update(environment)
os.chdir(folder)
sys.argv[1:] = arguments
sys.modules.pop(name, None)
runpy.run_module(name, run_name="__main__", alter_sys=True)
"""


def environment(**changed: str) -> dict[str, str]:
    """Return the environment of the package's programs."""
    known = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    return known | {"AMENT_PREFIX_PATH": known.get("AMENT_PREFIX_PATH") or sys.prefix} | changed


#: Environment at the time of the imports, before tests change variables.
_KNOWN = environment()


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


class Fork(subprocess.Popen[Any]):
    """A program in a fork."""

    def _execute_child(self, args: Sequence[str], *given: Any) -> None:
        folder, variables, streams = given[4], given[5], given[9:15]
        stdin, _, _, stdout, _, stderr = streams
        theirs = [own if place == -1 else place for own, place in enumerate((stdin, stdout, stderr))]
        orders = _orders()
        self._end, their_end = os.pipe()
        module = "plow_twin.__main__" if args[2] == "plow_twin" else args[2]
        text = json.dumps([module, args[3:], variables, os.fspath(folder or Path.cwd())]).encode()
        socket.send_fds(orders, [text], [*theirs, their_end])
        os.close(their_end)
        self.pid = int(orders.recv(64))
        self._child_created = True
        self._close_pipe_fds(*streams)  # type: ignore[attr-defined]

    def _internal_poll(self, _deadstate: object = None) -> int | None:
        return self._ended(0.0)

    def _wait(self, timeout: float | None) -> int:
        if (code := self._ended(timeout)) is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return code

    def _ended(self, timeout: float | None) -> int | None:
        if self.returncode is None and select.select([self._end], [], [], timeout)[0]:
            self.returncode = int(os.read(self._end, 64) or b"-9")  # a killed forking process writes no exit code
            os.close(self._end)
        return self.returncode


def start(module: str, arguments: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """Start a program as `Popen` does; `env` has the changed variables.

    It is forked if it is one of `_FORKED` and no variable was changed that imports may read.
    """
    variables = environment(**options.pop("env", {}))
    command = [sys.executable, "-m", module, *arguments]
    changed = {name for name, _ in variables.items() ^ _KNOWN.items()}
    forked = module in _FORKED and changed <= _LATE and not options.keys() & {"preexec_fn", "start_new_session"}
    forked &= module != "plow_twin" or not _WITH_ROS & {*arguments}
    return (Fork if forked else subprocess.Popen)(command, env=variables, **options)
