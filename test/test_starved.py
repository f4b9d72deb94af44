"""With a shortage on the machine, the twin works, or names the shortage in one line."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from test_live import ROOT, _csv, _live
from waiting import until

from plow_twin.cli.app import EXTRA_OF_MODULE
from plow_twin.record.replay import replay

LIVE = ("live", "load.csv", "--scene", "paper", "--record", "run", "-q")


def _limit(**most: int) -> Callable[[], None]:
    def limit() -> None:
        for kind, number in most.items():
            resource.setrlimit(getattr(resource, f"RLIMIT_{kind}"), (number, number))

    return limit


def _run(
    folder: Path,
    *words: str,
    before: Callable[[], None] | None = None,
    within: tuple[str, ...] = (),
    **environment: str | None,
) -> tuple[int, list[str]]:
    """Run a command under a shortage. Return its exit code and the lines of its standard error."""
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "10000", **environment}
    completed = subprocess.run(
        [*within, sys.executable, "-m", "plow_twin", *words],
        cwd=folder,
        env={name: value for name, value in variables.items() if value is not None},
        preexec_fn=before,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    return completed.returncode, completed.stderr.splitlines()


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Compile into the cache first, because the compiler needs more resources than a run."""
    folder = tmp_path_factory.mktemp("compiled")
    _csv(folder / "load.csv", 100)
    assert _run(folder, *LIVE) == (0, [])


@pytest.fixture
def folder(compiled: None, tmp_path: Path) -> Path:
    _csv(tmp_path / "load.csv", 1500)
    return tmp_path


@pytest.mark.parametrize(
    "limits",
    [
        {"before": _limit(AS=3_000_000_000, NOFILE=64)},
        {
            **{"HOME": None, "XDG_CACHE_HOME": None, "TERM": None, "COLUMNS": "20"},
            **{"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        },
        {"HOME": "/proc/nothing", "XDG_CACHE_HOME": "/proc/nothing"},
    ],
    ids=["3 GB of addresses, 64 files", "no home, no terminal, the locale C", "a home that is not there"],
)
def test_a_run_and_its_replay_work_with_few_resources(limits: dict[str, object], folder: Path) -> None:
    assert _run(folder, *LIVE, **limits) == (0, [])  # type: ignore[arg-type]
    report = replay(folder / "run")
    assert (report.exit_code, report.samples) == (0, 1500)


#: Shell script that runs a command with package, cache, home and /dev/shm read-only, as if another user had installed
#: the package.
NOTHING_WRITABLE = """
for place in "$PACKAGE" "$CACHE" "$HOME"; do
    mount --bind "$place" "$place"
    mount -o remount,bind,ro "$place"
done
mount -t tmpfs -o ro none /dev/shm
! touch "$PACKAGE/x" "$CACHE/x" "$HOME/x" /dev/shm/x 2>/dev/null
exec "$@"
"""
NAMESPACE = ("unshare", "--user", "--map-root-user", "--mount")


def test_a_run_uses_the_cache_of_another_user_without_write_access(folder: Path) -> None:
    if subprocess.run([*NAMESPACE, "true"], stderr=subprocess.DEVNULL).returncode:
        pytest.skip("the system allows no mounts of one's own")
    (folder / "home").mkdir()
    home, package = str(folder / "home"), str(ROOT / "plow_twin")
    places = {"HOME": home, "XDG_CACHE_HOME": home, "PACKAGE": package}
    places["CACHE"] = os.environ.get("NUMBA_CACHE_DIR", package)
    assert _run(folder, *LIVE, within=(*NAMESPACE, "sh", "-ec", NOTHING_WRITABLE, "sh"), **places) == (0, [])
    report = replay(folder / "run")
    assert (report.exit_code, report.samples) == (0, 1500)


def test_a_recording_in_progress_is_replayed_up_to_its_end(folder: Path) -> None:
    stale = ("--set", "excitation_timeout=3600")
    with _live("load.csv", "--follow", "--record", "run", *stale, cwd=folder) as live:
        live.until_count("samples_used", 1500)
        until(lambda: (folder / "run").is_dir() and replay(folder / "run").samples == 1500, "all samples")
        assert replay(folder / "run").exit_code == 3
        assert live.stop() == 0
    report = replay(folder / "run")
    assert (report.exit_code, report.samples) == (0, 1500)


@pytest.mark.parametrize(
    ("limits", "code", "message"),
    [
        ({"before": _limit(AS=150_000_000)}, 1, "a library cannot be loaded"),
        ({"before": _limit(FSIZE=0)}, 1, "File too large"),
        ({"before": _limit(FSIZE=100_000)}, 3, "File too large"),
        ({"NUMBA_DISABLE_JIT": "1"}, 1, "NUMBA_DISABLE_JIT is set, expected it unset"),
    ],
    ids=["150 MB of addresses", "no room for a file", "100 kB for a file", "no compiled code"],
)
def test_lacking_resources_are_named(limits: dict[str, object], code: int, message: str, folder: Path) -> None:
    result, lines = _run(folder, *LIVE, **limits)  # type: ignore[arg-type]
    assert result == code and message in lines[0], lines
    assert len(lines) <= (2 if code == 3 else 1), lines  # a loss (exit code 3) may add a second line


#: A command that needs each library of an extra.
NEEDING: dict[str, tuple[str, ...]] = {
    "mcap": LIVE,
    "paho": ("live", "mqtt://127.0.0.1:9", "--map", "map.yaml", "--scene", "paper"),
    "asyncua": ("live", "opc.tcp://127.0.0.1:9", "--map", "nodes.yaml", "--scene", "paper"),
    "influxdb_client": ("live", "load.csv", "--scene", "paper", "--influx", "http://127.0.0.1:9/a/b"),
    "google": ("live", "load.csv", "--scene", "paper", "--mqtt-out", "mqtt://127.0.0.1:9", "--sparkplug", "a/b"),
    "prometheus_client": ("live", "load.csv", "--scene", "paper", "--metrics", "9464"),
    "starlette": ("live", "load.csv", "--scene", "paper", "--dashboard", "--listen", "127.0.0.1:0"),
    "pyarrow": ("live", "load.parquet", "--scene", "paper"),
    "rclpy": ("telemetry", "--mqtt-out", "mqtt://127.0.0.1:9/a"),
}


#: Program that runs each command in a fork in which its library cannot be imported.
WITHOUT = """
import os, sys
from plow_twin.cli.app import run
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] == module:
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)
for module, words in NEEDING.items():
    found = module in sys.modules
    if not (pid := os.fork()):
        sys.meta_path.insert(0, Missing())
        os._exit(run(words))
    _, status = os.waitpid(pid, 0)
    print("ended", module, os.waitstatus_to_exitcode(status), found, file=sys.stderr, flush=True)
"""


def test_a_missing_library_is_named_with_its_extra(tmp_path: Path) -> None:
    _csv(tmp_path / "load.csv", 10)
    (tmp_path / "load.parquet").write_bytes(b"PAR1")
    (tmp_path / "map.yaml").write_text("excitation: {topic: a, fields: {fx: x, fy: y, m: m}}\n")
    (tmp_path / "nodes.yaml").write_text("excitation: {fx: {node: i=1}, fy: {node: i=2}, m: {node: i=3}}\n")
    completed = subprocess.run(
        [sys.executable, "-c", f"NEEDING = {NEEDING!r}\n{WITHOUT}"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "10000"},
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    errors = [line for line in completed.stderr.splitlines() if not line.startswith("OK status")]
    expected = [
        [f"needs {module}, which is not installed: pip install 'plow_twin[{EXTRA_OF_MODULE[module]}]'",
         f"ended {module} 1 False"]
        for module in NEEDING
    ]  # fmt: skip
    assert len(errors) == 2 * len(NEEDING), errors
    for part, line in zip((part for both in expected for part in both), errors, strict=True):
        assert part in line


def test_two_runs_into_one_folder_are_both_complete(folder: Path) -> None:
    words = [sys.executable, "-m", "plow_twin", *LIVE]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    runs = [subprocess.Popen(words, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    output = [run.communicate()[1] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], output
    folders = sorted(folder.glob("run*"))
    assert len(folders) == 2 and any("is not empty" in text for text in output), (folders, output)
    assert [(replay(run).exit_code, replay(run).samples) for run in folders] == [(0, 1500)] * 2
