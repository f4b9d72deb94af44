"""The rerun viewer as a child process on the loopback address, which ends with its parent."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final
from urllib.parse import quote

import rerun as rr
import rerun.blueprint as rrb

from plow_twin.errors import RecordingError

LOOPBACK: Final = "127.0.0.1"
#: Memory of viewer and of server, beyond which they discard the oldest data.
_MEMORY: Final = "2GB"
_START_S: Final = 60.0


def viewer_program() -> str:
    """Return the path of the rerun program, or raise `RecordingError` if it is not installed."""
    # the end of the wrapper script `rerun` on PATH would not end its child process
    spec = find_spec("rerun_cli")
    beside = Path(spec.origin).with_name("rerun") if spec is not None and spec.origin is not None else None
    program = str(beside) if beside is not None and beside.exists() else shutil.which("rerun")
    if program is None:
        raise RecordingError("the program `rerun` is not installed: pip install 'plow_twin[view]'")
    return program


@dataclass(frozen=True)
class Viewer:
    """A running viewer. `url` receives data. `page` is the address of its web page, or empty for a native window."""

    process: subprocess.Popen[bytes]
    url: str
    page: str

    def attach(self, stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> None:
        """Attach a stream with its blueprint."""
        stream.connect_grpc(self.url, default_blueprint=blueprint)

    def close(self) -> None:
        """End the viewer, even if it is suspended."""
        self.process.kill()
        self.process.wait()


def start_viewer(*, web_port: int | None = None) -> Viewer:
    """Start a viewer as a web page on `web_port`, or as a window without `web_port`.

    Raise `RecordingError` if the viewer is missing or does not answer.
    """
    port, web_port = free_port(), None if web_port is None else page_port(web_port)
    command = [viewer_program(), "--bind", LOOPBACK, "--port", str(port), "--memory-limit", _MEMORY]
    if web_port is not None:
        command += ["--serve-web", "--web-viewer-port", str(web_port), "--server-memory-limit", _MEMORY]
    bound = shutil.which("setpriv")
    if bound is not None:  # the kernel ends the viewer when this process ends
        command = [bound, "--pdeathsig", "KILL", *command]
    environment = {"RUST_LOG": "warn", **os.environ}
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=environment)
    viewer = Viewer(process, _address(port), "" if web_port is None else page_address(web_port, port))
    deadline = time.monotonic() + _START_S
    while not _answers(port):
        if process.poll() is not None or time.monotonic() > deadline:
            viewer.close()
            raise RecordingError(f"rerun: got no answer on port {port}, expected a viewer (exit code {process.poll()})")
        time.sleep(0.1)
    return viewer


def _address(port: int) -> str:
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def page_address(web_port: int, port: int) -> str:
    """Return the address of the web page in the dark theme."""
    return f"http://{LOOPBACK}:{web_port}/?url={quote(_address(port), safe='')}&theme=dark"


def free_port() -> int:
    """Return a free port of the loopback address."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def page_port(requested: int) -> int:
    """Return the given port for a page, or a free port for 0. Raise `RecordingError` if the port is in use."""
    if not requested:
        return free_port()
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, requested))
        except OSError as error:
            raise RecordingError(f"web port: got {requested}, expected a free port, or 0 ({error.strerror})") from error
    return requested


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((LOOPBACK, port)) == 0
