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
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from threading import Thread
from typing import IO, Any, Self

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
    variables = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    return variables | {"AMENT_PREFIX_PATH": variables.get("AMENT_PREFIX_PATH") or sys.prefix} | changed


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


class Fork:
    """A program in a fork, with the interface of `subprocess.Popen` that tests use."""

    def __init__(
        self, args: Sequence[str], env: dict[str, str], *, cwd: str | os.PathLike[str] | None = None,
        stdin: Any = None, stdout: Any = None, stderr: Any = None, text: bool = False,
    ) -> None:  # fmt: skip
        self.args, self.returncode = args, None
        with ExitStack() as theirs:

            def stream(number: int, target: Any) -> tuple[int, Any]:
                """Return the program's end of a stream, and our end of a pipe."""
                if target is None:
                    return number, None
                if target == subprocess.DEVNULL:
                    return theirs.enter_context(open(os.devnull, "r+b", buffering=0)).fileno(), None
                if target != subprocess.PIPE:
                    return target.fileno(), None
                ends = os.pipe()
                theirs.callback(os.close, ends[number > 0])
                mode = ("w" if number == 0 else "r") + ("" if text else "b")
                return ends[number > 0], open(ends[number == 0], mode)

            inward, self.stdin = stream(0, stdin)
            outward, self.stdout = stream(1, stdout)
            errors, self.stderr = (outward, None) if stderr == subprocess.STDOUT else stream(2, stderr)
            self._end, their_end = os.pipe()
            theirs.callback(os.close, their_end)
            module = "plow_twin.__main__" if args[2] == "plow_twin" else args[2]
            order = json.dumps([module, args[3:], env, os.fspath(cwd or Path.cwd())]).encode()
            socket.send_fds(_orders(), [order], [inward, outward, errors, their_end])
            self.pid = int(_orders().recv(64))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream is not None:
                stream.close()
        self.wait()

    def poll(self) -> int | None:
        return self._ended(0.0)

    def wait(self, timeout: float | None = None) -> int:
        if (code := self._ended(timeout)) is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return code

    def communicate(self, timeout: float | None = None) -> tuple[Any, Any]:
        """Close the input and wait for the end. Return the texts of the two output streams, which are then closed."""
        if self.stdin is not None:
            with suppress(BrokenPipeError):
                self.stdin.close()
        texts: list[Any] = [None, None]

        def read(number: int, stream: IO[Any]) -> None:
            with stream:
                texts[number] = stream.read()

        outputs = enumerate((self.stdout, self.stderr))
        streams = [(number, output) for number, output in outputs if output is not None and not output.closed]
        readers = [Thread(target=read, args=found, daemon=True) for found in streams]
        for reader in readers:
            reader.start()
        self.wait(timeout)
        for reader in readers:
            reader.join(timeout)
        return texts[0], texts[1]

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            # the program may have ended since
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _ended(self, timeout: float | None) -> int | None:
        if self.returncode is None and select.select([self._end], [], [], timeout)[0]:
            self.returncode = int(os.read(self._end, 64) or b"-9")  # a killed forking process writes no exit code
            os.close(self._end)
        return self.returncode


def start(module: str, arguments: Sequence[str], **options: Any) -> subprocess.Popen[Any] | Fork:
    """Start a program as `Popen` does; `env` has the changed variables.

    It is forked if it is one of `_FORKED` and no variable was changed that imports may read.
    """
    variables = environment(**options.pop("env", {}))
    command = [sys.executable, "-m", module, *arguments]
    changed = {name for name, _ in variables.items() ^ _KNOWN.items()}
    forked = module in _FORKED and changed <= _LATE and not options.keys() & {"preexec_fn", "start_new_session"}
    forked &= module != "plow_twin" or not _WITH_ROS & {*arguments}
    if forked:
        return Fork(command, env=variables, **options)
    # as in a fork: a run of the tests by nohup ignores SIGHUP, and so would its programs
    options.setdefault("preexec_fn", lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL))
    return subprocess.Popen(command, env=variables, **options)
