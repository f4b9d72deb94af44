"""Set-up of each test process: ROS is restricted to this machine, and skipped tests are checked."""

from __future__ import annotations

import atexit
import fcntl
import hashlib
import os
import shutil
import signal
import tempfile
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, settings

ROOT = Path(__file__).resolve().parent.parent
SKIPS = ROOT / "test" / "skips.txt"
FIRST = ROOT / "test" / "first.txt"
#: Name of the environment variable with the folder of the locks of `_compile_once`.
LOCKS = "PLOW_TWIN_COMPILING"


def _prepare_environment() -> None:
    """Set the environment that child processes inherit, before rclpy and numpy are imported."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.pop("ROS_LOCALHOST_ONLY", None)
    # ROS domains 1 to 101 use no ephemeral ports; each process of each run gets its own domain
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    number = 8 * (os.getppid() if worker else os.getpid()) + int(worker.removeprefix("gw") or 0)
    os.environ["ROS_DOMAIN_ID"] = str(1 + number % 101)
    # the processes of a suite already use all cores, so more threads of linear algebra would only wait for each other
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    logs = tempfile.mkdtemp(prefix="plow_twin-ros-log-")
    atexit.register(shutil.rmtree, logs, ignore_errors=True)
    os.environ["ROS_LOG_DIR"] = logs
    # in a suite started in the background by a shell, SIGINT is ignored; tests that send SIGINT need the handler of
    # Python
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _compile_once() -> None:
    """Prevent the processes of a suite from compiling the same kernels in parallel.

    Each signature of a kernel has a lock file, which the compiling process locks. To avoid a deadlock, locks are taken
    in the order of calls, and by one thread of a process only.
    """
    if "PYTEST_XDIST_WORKER" not in os.environ:
        os.environ[LOCKS] = tempfile.mkdtemp(prefix="plow_twin-compiling-")
        atexit.register(shutil.rmtree, os.environ[LOCKS], ignore_errors=True)
        return
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compile_alone = Dispatcher.compile

    def compile_once(dispatcher: Any, signature: Any) -> Any:
        name = f"{dispatcher.py_func.__module__}.{dispatcher.py_func.__qualname__} {signature}"
        place = Path(os.environ[LOCKS]) / hashlib.blake2b(name.encode(), digest_size=8).hexdigest()
        with global_compiler_lock, place.open("wb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            return compile_alone(dispatcher, signature)

    Dispatcher.compile = compile_once


_prepare_environment()
_compile_once()
settings.register_profile("plow_twin", deadline=None, derandomize=True, database=None)
# profile of `make stress`: it prints the seed, draws new examples in each run, and shrinks failing examples
FRESH = (Phase.explicit, Phase.generate, Phase.shrink)
settings.register_profile("stress", deadline=None, derandomize=False, database=None, print_blob=True, phases=FRESH)
settings.load_profile("plow_twin")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--check-skips", action="store_true", help="fail when a test is skipped that test/skips.txt does not list"
    )
    parser.addoption("--compiles", action="store_true", help="list the kernels that tests compiled, with their time")
    parser.addoption("--golden-update", action="store_true", help="pin the digests of test/golden.py anew")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--compiles"):
        from compiles import Compiles

        config.pluginmanager.register(Compiles())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    place = {name: number for number, name in enumerate(_listed(FIRST))}
    items.sort(key=lambda item: place.get(item.path.name, len(place)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for nodeid, reason in _skipped(terminalreporter):
        terminalreporter.write_line(f"skipped: {nodeid} | {reason}")


def pytest_sessionfinish(session: pytest.Session) -> None:
    if not session.config.getoption("--check-skips") or hasattr(session.config, "workerinput"):
        return
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    allowed = _listed(SKIPS)
    skipped = _skipped(reporter)
    unknown = [entry for entry in skipped if not any(fnmatchcase(entry[0], glob) for glob in allowed)]
    for nodeid, reason in unknown:
        reporter.write_line(f"not in test/skips.txt: {nodeid} | {reason}", red=True)
    if unknown and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def _skipped(reporter: pytest.TerminalReporter) -> list[tuple[str, str]]:
    reports = reporter.stats.get("skipped", [])
    return [(report.nodeid, report.longrepr[2] if isinstance(report.longrepr, tuple) else "") for report in reports]


def _listed(file: Path) -> list[str]:
    """Return the text before the first bar in each line that is not a comment."""
    lines = (line.partition("#")[0].strip() for line in file.read_text(encoding="utf-8").splitlines())
    return [line.partition("|")[0].strip() for line in lines if line]
