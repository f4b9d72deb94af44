"""The operator's screen shows the results of the twin, and its pages do not affect the twin."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock
from urllib.parse import urlsplit

import browser
import numpy as np
import pytest
from commands import plow_twin_here, started
from record_support import PAPER_AMPLITUDE, paper_sample, record_run, records_of
from waiting import until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from plow_twin import dashboard
from plow_twin.dashboard.access import PageAccess
from plow_twin.dashboard.feed import Feed, Motion
from plow_twin.dashboard.history import SPAN_S, History
from plow_twin.dashboard.link import Link, pair
from plow_twin.dashboard.run import RunFeed
from plow_twin.dashboard.screen import Screen
from plow_twin.dashboard.server import MOST_PAGES, TOO_MANY
from plow_twin.record.entries import EntryRecord
from plow_twin.record.reader import RunReader
from plow_twin.record.recording import read_recording
from plow_twin.record.replay import replay
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.solve.state import ROW, WITH_INTERVALS
from plow_twin.stream.journal import Digest, Mark, Parameter, Pose, Unused
from plow_twin.stream.outputs import CLEARANCE_NAMES, NOTHING, SLOW, Published

TOKEN = "a token of the screen"
FACTS: dict[str, Any] = {"scene": "paper", "pads": [], "thresholds": {}}


def _published(second: float, peak: float, load: float = 0.0) -> Published:
    rows = np.zeros(1, ROW)
    rows["stamp_ns"], rows["peak"], rows["samples"] = round(second * 1e9), peak, 1
    return Published(rows, NOTHING.slow)


def test_a_feed_without_a_reader_does_not_wait_and_keeps_the_peaks() -> None:
    link, theirs = pair()
    feed = Feed(link, FACTS)
    for index in range(2000):
        feed.publication(_published(1.0 + 1e-3 * index, 7e5 if index == 900 else 10.0))
        feed.part("state", (0, "x" * 10_000, {}))
        feed.turn()
    assert feed.not_taken > 0 and feed.taken + feed.not_taken == 2000
    with theirs:
        far, updates = Link(theirs), []
        while (update := far.receive()) is not None:
            updates.append(update)
        feed.turn()
        updates.append(far.receive() or {})
        # the first update contains the facts; the update after a refused update contains the largest force of both
        assert updates[0]["facts"]["can_ask"] is False and len(updates) == feed.taken
        assert max(update["motion"]["peak"][0] for update in updates) == 7e5
        assert updates[-1]["not_taken"] == feed.not_taken and updates[-1]["motion"]["t"] == pytest.approx(2.999)
    feed.turn()
    assert link.broken
    link.close()


def test_the_screen_gets_each_second_of_a_file_and_an_output_keeps_its_rate() -> None:
    for by_second, expected in ((True, [float(second) for second in range(1, 30)]), (False, [])):
        link, theirs = pair()
        feed = Feed(link, FACTS, by_second=by_second)
        for index in range(580):  # the stamps have a rate of 20 Hz, but publications are sent as fast as possible
            feed.publication(_published(1.0 + 0.05 * index, 1.0 + index // 20))
        with theirs:
            far, peaks = Link(theirs), []
            while (update := far.receive()) is not None:
                peaks.append(update["motion"]["peak"][0])
        assert peaks == expected[:-1]
        link.close()


def test_the_history_has_each_second_of_an_hour_once_and_is_cleared_when_stamps_step_back() -> None:
    history = History()
    motion = {"load_low": [0, -1, None], "load_high": [0, 1, None], "was_held": False}
    for version in range(1, 2 * SPAN_S + 1):
        for peak in (5.0, 9.0, 2.0):
            stepped_back = history.add({**motion, "t": 100.0 + version, "peak": [peak] * 8}, 3 * version)
            assert not stepped_back
    seconds = history.since(0)
    assert len(seconds) == SPAN_S and seconds[-1][:2] == [100 + 2 * SPAN_S, 9.0]
    assert history.since(6 * SPAN_S) == [] and len(history.since(6 * SPAN_S - 4)) == 2
    assert history.add({**motion, "t": 50.0, "peak": [1.0] * 8}, 10**6)
    assert [row[0] for row in history.since(0)] == [50]
    for points in ([1.0] * 8 + [4.0] * 8, [2.0] * 8 + [3.0] * 8):
        history.add({**motion, "t": 50.5, "peak": [1.0] * 8, "points": points}, 10**6 + 1)
    assert history.since(0)[0][22:] == [2.0] * 8 + [4.0] * 8


def test_a_second_keeps_its_peak_if_an_earlier_second_arrives_later() -> None:
    history, motion = History(), Motion()
    for version, (t, peak) in enumerate([(10, 1.0), (11, 2.0), (10, 5.0), (12, 3.0)], 1):
        motion.stamp_ns, motion.peak = t * 10**9, np.full(8, peak)
        assert not history.add(motion.update(), version)
    assert [row[:2] for row in history.since(0)] == [[10, 5.0], [11, 2.0], [12, 3.0]]
    assert [row[0] for row in history.since(2)] == [10, 11, 12] and [row[0] for row in history.since(3)] == [12]
    motion.stamp_ns = 9 * 10**9
    assert history.add(motion.update(), 5) and [row[0] for row in history.since(0)] == [9]


def test_the_screen_shows_the_intervals_of_a_following_twin() -> None:
    link, theirs = pair()
    feed = Feed(link, FACTS)
    for low, high in ((5.0, 20.0), (7.0, 15.0)):
        published = _published(1.0, 10.0)
        published.rows["followed"], published.rows["peak_low"], published.rows["peak_high"] = WITH_INTERVALS, low, high
        feed.publication(published)
    feed.turn()
    with theirs:
        assert json.loads(theirs.recv(1 << 16))["motion"]["points"] == [7.0] * 8 + [20.0] * 8
    link.close()


def test_the_clearances_of_an_estimate_after_the_last_publication_are_shown_with_its_state() -> None:
    link, theirs = pair()
    feed = Feed(link, FACTS)

    def publish(second: float, low: float) -> None:
        slow = np.zeros(1, SLOW)
        slow["clearance"][:, CLEARANCE_NAMES.index("horizontal/p05")] = low
        feed.publication(Published(_published(second, 1.0).rows, slow))

    numbers = {f"{axis}{point}": "0.0265" for axis in ("horizontal", "vertical") for point in ("", "/p05", "/p95")}
    with theirs:
        far = Link(theirs)

        def shown() -> tuple[float, float]:
            feed.turn()
            clearance = (far.receive() or {})["motion"]["clearance"]
            return clearance["horizontal/p05"], clearance["vertical/p05"]

        # this publication precedes the estimate; it is summed up later, together with later publications
        publish(1.0, 0.0057)
        feed.part("estimate", (0, "", numbers))
        feed.part("status", (0, "", {"horizontal": "estimated", "vertical": "not_observable"}))
        feed.part("estimate", (0, "estimating", {"estimates": "1"}))
        assert shown() == shown() == (0.0265, 0.0)
        publish(2.0, 0.0264)
        assert shown() == (0.0264, 0.0)
        feed.part("estimate", (0, "", {}))  # the estimate is withdrawn
        feed.part("status", (0, "", {"horizontal": "withdrawn", "vertical": "withdrawn"}))
        assert shown() == (0.0264, 0.0)
    link.close()


@pytest.mark.parametrize(
    ("listen", "token", "expected"),
    [
        ("127.0.0.1", "", "HOST:PORT"),
        ("127.0.0.1:x", "", "HOST:PORT"),
        ("me@127.0.0.1:1", "", "HOST:PORT"),
        ("0.0.0.0:0", "", "127.0.0.1, or a token"),
        ("127.0.0.1:0", "short", "at least 16"),
        ("192.0.2.1:0", TOKEN, "a free address of this machine"),
    ],
)
def test_an_address_that_cannot_be_offered_is_refused(
    listen: str, token: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n0,1,2,3\n0.001,1,2,3\n")
    (tmp_path / "token").write_text(token + "\n")
    options = ("--dashboard", "--listen", listen, *(("--token-file", tmp_path / "token") if token else ()))
    done = plow_twin_here("live", tmp_path / "load.csv", "--scene", "paper", "--quiet", *options)
    assert done.returncode == 2 and expected in done.stderr and (not token or token not in done.stderr)


def test_options_of_a_screen_without_the_screen_are_refused(tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n0,1,2,3\n0.001,1,2,3\n")
    done = plow_twin_here("live", tmp_path / "load.csv", "--scene", "paper", "--listen", "127.0.0.1:0")
    assert done.returncode == 2 and "--listen: expected it only with --dashboard" in done.stderr


def test_a_screen_reports_that_it_waits_for_a_file(tmp_path: Path) -> None:
    file = tmp_path / "load.csv"
    command = [sys.executable, "-m", "plow_twin", "live", str(file), *OPTIONS, "--follow", "--dashboard"]
    pipes = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    with started([*command, "--listen", "127.0.0.1:0"], **pipes) as process:
        assert "the page opens after it" in _said(process, f"plow-twin: {file}: waiting for its first line")
        file.write_text("t,fx,fy,m\n")
        assert _said(process, "screen: ").split()[1].startswith("http://127.0.0.1:")
        process.kill()


def test_foreign_host_names_are_refused() -> None:
    here, beyond = PageAccess("127.0.0.1", 8070), PageAccess("0.0.0.0", 8070, TOKEN)
    assert all(here.answers_to(name) for name in ("localhost:8070", "127.0.0.1:8070", "[::1]:8070"))
    assert not any(here.answers_to(name) for name in ("evil.example:8070", "192.168.1.5:8070", "", "["))
    assert beyond.answers_to("192.168.1.5:8070") and beyond.answers_to(socket.gethostname())
    assert not beyond.answers_to("evil.example:8070")
    assert here.is_own("http://localhost:8070", "localhost:8070") and here.is_own(None, "localhost:8070")
    assert not here.is_own("http://localhost:9000", "localhost:8070") and not here.is_own("null", "localhost:8070")


def _data(url: str, **options: Any) -> ClientConnection:
    return connect(f"{url.replace('http', 'ws')}data", max_size=None, close_timeout=0.1, **options)


def _status(url: str, **headers: str) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def test_requests_without_token_from_other_pages_or_under_other_names_are_refused() -> None:
    with Screen(PageAccess("127.0.0.1", 0, TOKEN), FACTS) as screen:
        screen.feed.turn()
        url = screen.url
        assert _status(url) == 200 and _status(url + "screen.js") == 200
        assert _status(url + "../server.py") == _status(url + "%2e%2e/server.py") == 404
        foreign = ({"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Origin": "http://["})
        assert [_status(url, **headers) for headers in foreign] == [403] * 3
        with pytest.raises(InvalidStatus, match="403"):
            _data(url, origin="http://evil.example")
        for credentials in ({"token": TOKEN[:-1]}, {"token": ["x"]}, {}, []):
            with _data(url) as page, pytest.raises(ConnectionClosed) as closed:
                page.send(json.dumps(credentials))
                page.recv(timeout=10)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 4401
        with ExitStack() as opened:
            # connections without a token do not use up the limited number of pages
            pages = [opened.enter_context(_data(url, origin=url.rstrip("/"))) for _ in range(MOST_PAGES + 1)]
            for page in reversed(pages):
                page.send(json.dumps({"token": TOKEN}))
                if page is not pages[0]:
                    assert json.loads(page.recv(timeout=10))["facts"]["scene"] == "paper"
            with pytest.raises(ConnectionClosed) as closed:
                pages[0].recv(timeout=10)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == TOO_MANY
        command_line = (
            Path(f"/proc/{screen.process.pid}/cmdline").read_bytes()
            + Path(f"/proc/{screen.process.pid}/environ").read_bytes()
        )
        assert TOKEN.encode() not in command_line
    assert screen.process.returncode == 0


def _memory_kb(pid: int) -> int:
    text = Path(f"/proc/{pid}/status").read_text()
    return int(next(line for line in text.splitlines() if line.startswith("VmRSS")).split()[1])


def test_a_frozen_page_takes_no_memory_and_later_continues_with_the_newest_data() -> None:
    with (
        Screen(PageAccess("127.0.0.1", 0), FACTS) as screen,
        socket.create_connection(("127.0.0.1", int(screen.url.rstrip("/").rpartition(":")[2]))) as raw,
    ):
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
        with _data(screen.url, sock=raw, ping_interval=None, max_queue=1) as frozen, _data(screen.url) as page:
            assert "version" in json.loads(page.recv())
            before, text = _memory_kb(screen.process.pid), "x" * 1000  # longer texts are cut
            for index in range(160):  # 8 MB of messages in total
                screen.feed.publication(_published(1.0 + index, float(index)))
                screen.feed.part("state", (0, str(index), {str(number): text for number in range(50)}))
                while not screen.feed.send():
                    time.sleep(2e-3)
                newest = json.loads(page.recv(timeout=30))
            while newest.get("motion", {}).get("t", 0) < 160.0:
                newest = json.loads(page.recv(timeout=30))
            assert _memory_kb(screen.process.pid) - before < 5_000
            message = json.loads(frozen.recv(timeout=30))
            while message.get("motion", {}).get("t", 0) < 160.0:
                message = json.loads(frozen.recv(timeout=30))
            assert message["skipped"] > newest["skipped"] + 20 and message["seconds"][-1][1] == 159.0


def _row(index: int) -> str:
    phase = float(np.sin(2e-3 * index))
    return ",".join([repr(1e-3 * index), *(repr(phase * amplitude) for amplitude in PAPER_AMPLITUDE)]) + "\n"


COUNT = 6000
#: Options with an alarm threshold that the forces exceed. The timeout is so long that the load is never held, because
#: the stamps differ from the wall clock.
OPTIONS = ("--scene", "paper", "--set", "excitation_timeout=3600", "--set", "alarm_force=[1.5e5,1e9]", "--json")


@contextmanager
def _twin(*options: str | Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a twin with a screen. The twin reads standard input."""
    command = [sys.executable, "-m", "plow_twin", "live", "-", *OPTIONS, "--dashboard", "--listen", "127.0.0.1:0"]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with started([*command, *map(str, options)], **pipes) as process:
        assert process.stdin is not None
        process.stdin.write("t,fx,fy,m\n")
        process.stdin.flush()
        yield process, _said(process, "screen: ").split()[1]


def _said(process: subprocess.Popen[str], begin: str) -> str:
    assert process.stderr is not None
    while line := process.stderr.readline():
        if line.startswith(begin):
            return line
    raise AssertionError(f"not said: {begin}")


def _feed(process: subprocess.Popen[str], begin: int = 0, end: int = COUNT) -> None:
    """Send samples at three times their real-time rate."""
    assert process.stdin is not None
    for first in range(begin, end, 60):
        process.stdin.write("".join(map(_row, range(first, min(first + 60, end)))))
        process.stdin.flush()
        time.sleep(0.02)


def _stopped(process: subprocess.Popen[str]) -> dict[str, Any]:
    """End the input and wait for the twin. Return its diagnostics and its output since the start."""
    assert process.stdin is not None
    process.stdin.close()
    process.stdin = None
    _said(process, "the input has ended")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    shown: dict[str, Any] = json.loads(out)
    return shown


def _digests(run: Path) -> list[Digest]:
    entries = (record.entry for record in records_of(run) if isinstance(record, EntryRecord))
    return [entry for entry in entries if isinstance(entry, Digest)]


def test_slow_frozen_and_killed_pages_and_servers_do_not_affect_the_twin(tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n" + "".join(map(_row, range(COUNT))))
    done = plow_twin_here("live", tmp_path / "load.csv", *OPTIONS, "--record", tmp_path / "alone")
    with _twin("--record", tmp_path / "watched") as (process, url), ExitStack() as pages:
        _feed(process, 0, 60)
        open_pages = [pages.enter_context(_data(url, ping_interval=None, max_queue=1)) for _ in range(12)]
        killed, *_, last = open_pages
        killed.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        killed.socket.close()
        _feed(process, 60, COUNT // 2)
        assert json.loads(last.recv())["motion"]["t"] >= 0.0
        server = int(next(Path(f"/proc/{process.pid}/task").glob("*/children")).read_text().split()[0])
        os.kill(server, signal.SIGSTOP)
        _feed(process, COUNT // 2)
        os.kill(server, signal.SIGCONT)
        report = _stopped(process)
    alone = json.loads(done.stdout)
    assert report["input"]["samples_used"] == alone["input"]["samples_used"] == str(COUNT)
    assert _digests(tmp_path / "watched") == _digests(tmp_path / "alone") != []
    assert not report["recorder"]["lost"] and not Path(f"/proc/{server}").exists()


def test_acknowledgements_and_marks_of_an_operator_are_journalled(tmp_path: Path) -> None:
    with _twin("--record", tmp_path / "run") as (process, url), _data(url) as page:
        _feed(process)
        received: dict[str, Any] = {}
        events: list[dict[str, Any]] = []

        def see(reached: Callable[[], bool]) -> None:
            while not reached():
                message = json.loads(page.recv(timeout=30))
                events.extend(message.get("events", ()))
                received.update({name: part[2] for name, part in message.get("parts", {}).items()})
                received.update({key: message[key] for key in ("motion", "seconds") if message.get(key)})

        see(lambda: received.get("motion", {}).get("t", 0) >= 0.999e-3 * COUNT)
        assert received["alarms"]["force_latched"] == "warn" and received["motion"]["clearance"]["horizontal"] > 0.02
        page.send("no JSON")
        page.send(json.dumps({"do": "reset"}))  # the page itself never sends such a request
        page.send(json.dumps({"do": "mark", "text": "x" * 1000}))
        page.send(json.dumps({"do": "mark", "text": "<b>shift</b> " + "x" * 180}))
        page.send(json.dumps({"do": "acknowledge"}))
        see(lambda: len(events) >= 3)
        assert [(event["kind"], event["done"]) for event in events] == [
            ("mark", False), ("mark", True), ("acknowledge", True),
        ]  # fmt: skip
        assert "got 1000 characters, expected 1 to 200" in events[0]["text"]
        _stopped(process)
    largest = max(max(row[1:9]) for row in received["seconds"])
    assert largest > 1e5
    entries = [record.entry for record in records_of(tmp_path / "run") if isinstance(record, EntryRecord)]
    marks = [entry.text for entry in entries if isinstance(entry, Mark) and not entry.text.startswith("alarm")]
    assert marks == ["<b>shift</b> " + "x" * 180]
    assert [entry.name for entry in entries if isinstance(entry, Parameter)] == ["alarms_acknowledged"]
    assert replay(tmp_path / "run").exit_code == 0


def test_a_killed_server_is_reported_once_and_the_twin_continues(tmp_path: Path) -> None:
    with _twin() as (process, _):
        _feed(process, 0, 600)
        server = int(next(Path(f"/proc/{process.pid}/task").glob("*/children")).read_text().split()[0])
        os.kill(server, signal.SIGKILL)
        _said(process, "plow-twin: the server of the screen has ended")
        _feed(process, 600)
        assert process.stdin is not None
        process.stdin.close()
        process.stdin = None
        out, err = process.communicate(timeout=60)  # the killed server does not delay the end
    assert process.returncode == 0 and json.loads(out)["input"]["samples_used"] == str(COUNT)
    assert "server of the screen" not in err


def test_a_recording_is_shown_during_and_after_the_run_and_accepts_no_requests(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "plow_twin", "dashboard", str(tmp_path / "run"), "--listen", "127.0.0.1:0"]
    with _twin("--record", tmp_path / "run") as (process, _):
        _feed(process, 0, 600)
        with started(command, stderr=subprocess.PIPE) as shown, _data(_said(shown, "screen: ").split()[1]) as page:
            seconds: dict[int, list[Any]] = {}
            received: dict[str, Any] = {}

            def see(reached: Callable[[], bool]) -> None:
                while not reached():
                    message = json.loads(page.recv(timeout=30))
                    seconds.update({row[0]: row for row in message.get("seconds", ())})
                    received.update({key: message[key] for key in ("facts", "motion", "events") if message.get(key)})
                    received.update(message.get("parts", {}))

            see(lambda: bool(seconds))
            _feed(process, 600)
            _stopped(process)
            see(lambda: any("recording: complete" in event["text"] for event in received.get("events", ())))
            _, peaks = read_recording(tmp_path / "run")["contact_peaks"].numpy()
            largest = pytest.approx(peaks[:, 16:].max(), rel=1e-6)
            # a busy server may send the last seconds after the event
            see(lambda: max(max(row[1:9]) for row in seconds.values()) == largest)
            shown.send_signal(signal.SIGINT)
            assert shown.wait(20) == 0
    assert received["facts"]["can_ask"] is False and received["input"][2]["samples_used"] == str(COUNT)
    assert received["alarms"][2]["force_place"] and received["motion"]["clearance"]["vertical"] == pytest.approx(0.03)


def test_a_recording_s_inputs_are_counted_by_name(tmp_path: Path) -> None:
    samples = [paper_sample(index) for index in range(20)]
    poses = [Pose(sample.stamp_ns, (0.0, 0.0, 0.0)) for sample in samples[:7]]
    unused = [Unused("head_pose", "", "late", 2, (), ()), Unused("excitation", "", "repeated", 3, (), ())]
    run = record_run(tmp_path / "run", [*samples, *poses, *unused])
    parts: dict[str, Any] = {}
    reader = RunReader(run.folder)
    feed = cast(Feed, SimpleNamespace(part=parts.__setitem__, motion=MagicMock(), event=None, send=lambda: True))
    shown = RunFeed(feed, reader.header, lambda: False)
    for batch in reader.batches():
        shown.add(batch)
    counted = {name: value for name, value in parts["input"][2].items() if value != "0"}
    assert counted == {
        "source": "excitation", "samples_used": "20", "dropped_repeated": "3",
        "head_pose_used": "7", "head_pose_dropped": "2",
    }  # fmt: skip


#: Script that returns texts of the page as JSON.
_SEEN = """JSON.stringify({pads: document.querySelectorAll('#pads tbody tr').length,
    colors: [...document.querySelectorAll('#section rect.pad')].map((pad) => pad.getAttribute('fill')),
    alarms: document.getElementById('alarms').innerText, clearance: document.getElementById('clearance').innerText,
    inputs: document.getElementById('inputs').innerText, load: document.getElementById('load').innerText,
    source: document.getElementById('source').innerText, events: document.getElementById('events').innerText,
    banner: document.getElementById('banner').innerText, charts: document.querySelectorAll('#charts canvas').length,
    seconds: screenState.seconds.length, fooled: Boolean(window.fooled)})"""


#: Script that returns the smallest contrast between a text and its background (WCAG 2), without disabled controls.
_CONTRAST = """(() => {
    const parts = (color) => color.match(/[\\d.]+/g).map(Number);
    const light = (color) => parts(color).slice(0, 3).map((part) => part / 255)
        .map((part) => part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4)
        .reduce((sum, part, index) => sum + part * [0.2126, 0.7152, 0.0722][index], 0);
    const behind = (element) => {
        for (let one = element; one; one = one.parentElement) {
            const color = getComputedStyle(one).backgroundColor;
            if ((parts(color)[3] ?? 1) > 0) return light(color);
        }
        return 1;
    };
    const texts = [...document.querySelectorAll('h1, h2, td, th, p, span.pill, footer')]
        .filter((one) => one.innerText.trim());
    return Math.min(...texts.map((one) => {
        const [a, b] = [light(getComputedStyle(one).color), behind(one)].sort((x, y) => y - x);
        return (a + 0.05) / (b + 0.05);
    }));
})()"""


def _check_readable(page: browser.Page) -> None:
    """Check the contrast in both themes, and that a phone need not scroll the page sideways."""
    for theme in ("dark", "light"):
        page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])
        assert page.evaluate(_CONTRAST) >= 4.5, theme
    for width in (390, 1366):
        page.call("Emulation.setDeviceMetricsOverride", width=width, height=800, deviceScaleFactor=1, mobile=False)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.call("Emulation.clearDeviceMetricsOverride")


@pytest.mark.skipif(shutil.which("node") is None, reason="no node is installed")
def test_the_scripts_of_the_page_have_no_syntax_error() -> None:
    scripts = sorted((Path(dashboard.__file__).parent / "page").glob("*.js"))
    assert len(scripts) >= 4
    for script in scripts:
        subprocess.run(["node", "--check", str(script)], check=True)


@pytest.mark.skipif(browser.CHROMIUM is None, reason="no Chromium is installed")
def test_a_browser_shows_the_twin_and_names_as_text_and_loads_only_from_the_server(tmp_path: Path) -> None:
    name = "<img src=x onerror='window.fooled=1'>"
    scene = tmp_path / f"{name.replace('/', '')}.yaml"
    scene.write_text(dump_scene(load_scene("paper")))
    options = ("--scene", scene, "--set", f"hardware_id={name}", "--token-file", tmp_path / "token")
    options += ("--record", tmp_path / "run")  # without a recording, marks are refused
    (tmp_path / "token").write_text(TOKEN + "\n")
    with _twin(*options) as (process, line), ExitStack() as opened:
        url = line.partition("#")[0]
        page = opened.enter_context(browser.page(tmp_path / "browser", f"{url}#token={TOKEN.replace(' ', '%20')}"))

        def seen(reached: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
            shown: dict[str, Any] = {}
            until(lambda: shown.update(json.loads(page.evaluate(_SEEN))) or reached(shown), (shown, page.errors), 0.2)
            return shown

        seen(lambda page_facts: not page_facts["banner"])
        _feed(process)
        shown = seen(lambda found: "6000" in found["inputs"] and "was warn" in found["alarms"])
        assert shown["pads"] == 8 and shown["charts"] == 3 and len(set(shown["colors"])) > 1
        assert "25.000 mm" in shown["clearance"] and "assumed" in shown["clearance"]
        assert shown["seconds"] >= 6 and "kN m" in shown["load"] and name in shown["source"]
        _check_readable(page)
        page.evaluate("document.getElementById('mark-text').value = \"<img src=x onerror='window.fooled=1'>\"")
        page.evaluate("document.querySelector('#mark button').click()")
        page.evaluate("document.getElementById('acknowledge').click()")
        shown = seen(lambda found: "acknowledge" in found["events"] and name in found["events"])
        assert "was" not in shown["alarms"] and not shown["fooled"]
        assert page.evaluate("location.hash + location.search") == ""
        _stopped(process)
        seen(lambda found: "ended" in found["banner"] or "lost" in found["banner"])
        assert not page.errors and {urlsplit(request).netloc for request in page.requests} == {urlsplit(url).netloc}


@pytest.mark.skipif(browser.FIREFOX is None, reason="no Firefox is installed")
def test_firefox_shows_the_twin(tmp_path: Path) -> None:
    with _twin("--scene", "paper") as (process, line):
        url = line.partition("#")[0].split()[-1]
        with browser.firefox_page(tmp_path / "firefox", url) as page:
            _feed(process)
            shown: dict[str, Any] = {}
            until(
                lambda: shown.update(json.loads(page.evaluate(_SEEN)))
                or ("6000" in shown["inputs"] and "was warn" in shown["alarms"]),
                (shown, page.errors), 0.2,
            )  # fmt: skip
            assert (shown["pads"], shown["charts"], page.errors) == (8, 3, [])
            assert "25.000 mm" in shown["clearance"] and not shown["banner"]
        _stopped(process)
