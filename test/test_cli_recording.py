"""Output and exit codes of `replay`, `view` and `info` for recordings."""

from __future__ import annotations

import json
import re
import shutil
import socket
import struct
import subprocess
import urllib.request
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import browser
import forge
import numpy as np
import pytest
from commands import plow_twin, plow_twin_here
from PIL import Image
from record_support import Run, paper_sample, record_run, rewrite
from waiting import until

from plow_twin.cli.app import run as cli
from plow_twin.stream.intake import NS_PER_S
from plow_twin.stream.journal import Entry, Mark

SAMPLES = 600


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["view", "RUN", "--png", "x.png", "--web"], "--png cannot be combined with --out, --web or --follow"),
        (["view", "RUN", "--png", "x.png", "--follow"], "--png cannot be combined with --out, --web or --follow"),
        (["view", "RUN", "--follow", "--web", "--out", "x.rrd"], "--follow: got --out and --web, expected at most one"),
        (["analyse", "RUN", "--watch", "1", "--workers", "2"], "--watch cannot be combined with --dask or --workers"),
        (["analyse", "RUN", "--dask", "tcp://127.0.0.1:1"], "--dask: got one recording, expected many"),
        (["analyse", "RUN", "--workers", "2"], "--workers: got one recording, expected many"),
        (["analyse", "RUN/..", "--workers", "2", "--dask", "tcp://127.0.0.1:1"], "--workers cannot be combined"),
    ],
)
def test_options_without_effect_are_refused(
    words: list[str], expected: str, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli([word.replace("RUN", str(run.folder)) for word in words]) == 2
    assert expected in " ".join(capsys.readouterr().err.split())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return record_run(tmp_path_factory.mktemp("recording") / "run", map(paper_sample, range(SAMPLES)))


@pytest.mark.usefixtures("without_workers")
def test_an_analysis_without_measurements_shows_only_the_model(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, made = shutil.copytree(run.folder, tmp_path / "copy"), tmp_path / "again"
    assert cli(["replay", str(run.folder), "--write", str(made), "--quiet"]) == 0
    capsys.readouterr()
    recordings = [str(run.folder), str(copy), str(made)]
    assert cli(["analyse", *recordings, "--workers", "1", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert f"{copy}: left out: the same run as {run.folder}" in printed.err
    assert printed.out.count("Contacts computed") == 1 and "plow-twin compare" in printed.out
    assert "bias" not in printed.out and printed.out.count("no measured values to compare") == 2


def test_replay_of_an_unchanged_recording_exits_with_0(run: Run) -> None:
    completed = plow_twin("replay", run.folder, "--json")
    assert (completed.returncode, completed.stderr) == (0, "")
    facts = json.loads(completed.stdout)
    assert (facts["result"], facts["samples"], facts["divergences"]) == ("the same", SAMPLES, 0)
    assert facts["messages_compared"]["contact_forces"] == SAMPLES
    quiet = plow_twin_here("replay", run.file, "--quiet")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


def test_replay_of_a_changed_sample_exits_with_1_and_names_the_step(run: Run, tmp_path: Path) -> None:
    flipped = 321
    seen = 0

    def flip(topic: str, message: Any) -> bytes | None:
        nonlocal seen
        if not topic.endswith("journal/samples"):
            return None
        seen += 1
        if seen - 1 != flipped:
            return None
        fx = struct.pack("<d", paper_sample(flipped).wrench[0])
        place = message.data.index(fx)
        return bytes(message.data[:place] + struct.pack("<d", -struct.unpack("<d", fx)[0]) + message.data[place + 8 :])

    done = plow_twin("replay", rewrite(run.file, tmp_path / "flipped.mcap", flip))
    assert done.returncode == 1
    assert f"diverged: step {flipped}," in done.stderr
    assert "Traceback" not in done.stderr


def test_replay_of_another_build_warns(run: Run, tmp_path: Path) -> None:
    def other_build(record: dict[str, str]) -> dict[str, str]:
        if "build" in record:
            record["build"] = json.dumps(json.loads(record["build"]) | {"numba": "0.1"})
        return record

    done = plow_twin_here("replay", rewrite(run.file, tmp_path / "other.mcap", metadata=other_build), "--quiet")
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr.startswith(
        "plow-twin: warning: recorded by another build, which may round differently: numba 0.1"
    )


def test_every_verb_exits_with_3_for_a_truncated_recording(run: Run, tmp_path: Path) -> None:
    data = run.file.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    to_csv = ("--to", "csv", "--out", tmp_path / "tables")
    for verb, *options in (("replay",), ("view",), ("info",), ("analyse",), ("export", *to_csv)):
        done = plow_twin_here(verb, tmp_path / "cut.mcap", *options)
        assert done.returncode == 3, f"{verb}: {done.stderr}"
        assert f"did not close it; plow-twin doctor --repair {tmp_path / 'cut.mcap'} completes it" in done.stderr
    assert (tmp_path / "cut.rrd").stat().st_size > 10_000


def test_every_verb_exits_with_3_for_a_recording_that_stopped_early(tmp_path: Path) -> None:
    stopped = record_run(tmp_path / "run", map(paper_sample, range(100)), min_free_bytes=2**62)
    assert stopped.loss.closed and not stopped.loss.complete
    for verb in ("replay", "view", "info"):
        done = plow_twin_here(verb, stopped.folder)
        assert done.returncode == 3, f"{verb}: {done.stderr}"
        assert "stopped early" in done.stdout + done.stderr
        assert verb == "view" or f"expected at least {2**62} B" in done.stdout


def test_every_verb_exits_with_3_for_a_recording_with_losses(tmp_path: Path) -> None:
    lossy = record_run(tmp_path / "run", map(paper_sample, range(400)), queue_size=40, pause_every=200)
    assert lossy.loss.closed and lossy.loss.lost and lossy.loss.error is None
    for verb in ("replay", "view", "info"):
        done = plow_twin_here(verb, lossy.folder)
        assert done.returncode == 3, f"{verb}: {done.stderr}"
        assert "lost" in done.stdout + done.stderr


def test_info_and_doctor_state_the_duration_of_the_advances(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    end_ns = paper_sample(99).stamp_ns
    entries: list[Entry] = [*map(paper_sample, range(100)), Mark(end_ns + 60 * NS_PER_S, "long after")]
    folder = record_run(tmp_path / "run", entries).folder
    for verb, key in (("info", "duration_s"), ("doctor", "span_s")):
        assert cli([verb, str(folder), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)[key] == pytest.approx(0.099)


def test_info_counts_the_content_of_a_recording(run: Run) -> None:
    done = plow_twin_here("info", run.file, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["status"] == "complete"
    assert facts["lost"] == {}
    assert facts["messages"]["/plow_twin/journal/samples"] == SAMPLES
    assert facts["messages"]["/contact_forces"] == SAMPLES


def test_view_writes_to_the_given_file(run: Run, tmp_path: Path) -> None:
    done = plow_twin_here("view", run.folder, "--out", tmp_path / "picture.rrd")
    assert done.returncode == 0, done.stderr
    assert f"{SAMPLES} force rows" in done.stdout
    assert (tmp_path / "picture.rrd").read_bytes()[:4] == b"RRF2"


def ports_of(address: str) -> list[int]:
    return [int(port) for port in re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", address)]


def answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_view_refuses_recordings_that_cannot_be_drawn(run: Run, tmp_path: Path) -> None:
    refused = plow_twin_here("view", run.folder, "--out", tmp_path / "x.rrd", "--exaggerate", "1e+308")
    assert refused.returncode == 2 and "1e+308" in refused.stderr and "Traceback" not in refused.stderr
    # the journal of a run under the loads of its scene contains no samples
    own = rewrite(run.file, tmp_path / "own.mcap", metadata=lambda record: {**record, "excitation_source": "scene"})
    refused = plow_twin_here("view", own, "--out", tmp_path / "x.rrd", "--with", "paper")
    assert refused.returncode == 1 and "excitation_source" in refused.stderr


def test_view_reports_a_port_in_use(run: Run, tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        refused = plow_twin("view", run.folder, "--out", tmp_path / "x.rrd", "--web", "--web-port", str(port))
    assert refused.returncode == 1 and f"web port: got {port}" in refused.stderr and "serving" not in refused.stdout


@pytest.fixture(scope="module")
def served(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Yield the address that `view --web` prints, as long as it serves."""
    out = tmp_path_factory.mktemp("served") / "run.rrd"
    words = ["view", str(run.folder), "--out", str(out), "--web", "--quiet", "--web-port", "0"]
    process = forge.start("plow_twin", words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        address = re.search(r"http://127\.0\.0\.1:\S+", process.stdout.readline())
        assert address is not None
        for port in ports_of(address[0]):
            until(lambda: answers(port) or process.poll() is not None, "a server")  # noqa: B023
        assert process.poll() is None, "no server"
        yield address[0]
    finally:
        process.terminate()
        process.communicate(timeout=20)
    assert not any(map(answers, ports_of(address[0]))), "the server has outlived the command"


def test_view_serves_a_page_only_on_the_loopback_address(served: str) -> None:
    assert b"Rerun" in urllib.request.urlopen(served, timeout=60).read()
    listening = {line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]}
    for port in ports_of(served):
        assert f"0100007F:{port:04X}" in listening and f"00000000:{port:04X}" not in listening


@pytest.mark.skipif(browser.CHROMIUM is None, reason="no Chromium is installed")
def test_a_browser_shows_the_run_at_the_printed_address(served: str, tmp_path: Path) -> None:
    with browser.page(tmp_path, served) as page:
        # the cross-sections have a dark background; other pages of the viewer do not
        until(lambda: _dark(page.picture()) >= 0.15, f"a picture: {page.errors}, {page.requests}", pause_s=0.5)
        assert not page.errors
        # the page requests the dark theme, so almost no pixel is white, whatever the theme of the browser
        dots = np.asarray(Image.open(BytesIO(page.picture())).convert("L"))
        assert (dots > 230).mean() < 0.05
        assert any("ReadMessages" in request for request in page.requests)


def _dark(png: bytes) -> float:
    """Return the share of pixels that have the background colour of the cross-sections."""
    dots = np.asarray(Image.open(BytesIO(png)).convert("RGB")).astype(int)
    return float((np.abs(dots - (24, 26, 30)).max(axis=2) <= 3).mean())
