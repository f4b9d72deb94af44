"""Set-up of each test process: ROS is restricted to this machine, and skipped tests are checked."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import tempfile
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, settings
from ros_domain import claim_domain
from shared_work import FOLDER, compile_once

ROOT = Path(__file__).resolve().parent.parent
SKIPS = ROOT / "test" / "skips.txt"
FIRST = ROOT / "test" / "first.txt"


def _prepare_environment() -> None:
    """Set the environment that child processes inherit, before rclpy and numpy are imported."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.pop("ROS_LOCALHOST_ONLY", None)
    os.environ["ROS_DOMAIN_ID"] = claim_domain()
    # the processes of a suite already use all cores, so more threads of linear algebra would only wait for each other
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    logs = tempfile.mkdtemp(prefix="plow_twin-ros-log-")
    atexit.register(shutil.rmtree, logs, ignore_errors=True)
    os.environ["ROS_LOG_DIR"] = logs
    # in a suite started in the background by a shell, SIGINT is ignored; tests that send SIGINT need the handler of
    # Python
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _share_work() -> None:
    """Make the folder that the suite's processes share, in the first of them; others wait for kernels of others."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        compile_once()
    else:
        os.environ[FOLDER] = tempfile.mkdtemp(prefix="plow_twin-shared-work-")
        atexit.register(shutil.rmtree, os.environ[FOLDER], ignore_errors=True)


_prepare_environment()
_share_work()
settings.register_profile("plow_twin", deadline=None, derandomize=True, database=None)
# profile of `make stress`: it prints the seed, draws new examples in each run, and shrinks failing examples
FRESH = (Phase.explicit, Phase.generate, Phase.shrink)
settings.register_profile("stress", deadline=None, derandomize=False, database=None, print_blob=True, phases=FRESH)
settings.load_profile("plow_twin")


@pytest.fixture
def without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let studies of many recordings run in this process; `test_study_many` has the worker processes."""
    from plow_twin.study.analysis import many

    def here(tasks: Sequence[Any], waiting: list[int], workers: int, done: Callable[[int, Any], None]) -> None:
        for number in waiting:
            done(number, many.run_task(tasks[number]))

    monkeypatch.setattr(many, "_here", here)


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
