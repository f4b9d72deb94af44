"""A live view while the node records, by separate processes that can stop, fall behind and be ended."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from pathlib import Path

import forge
from network import free_port
from ros_processes import WAIT_S, bench
from sensor_msgs.msg import JointState
from waiting import until

from plow_twin.record.reader import RunReader


def stopped(pid: int) -> bool:
    return "\nState:\tT" in Path(f"/proc/{pid}/status").read_text()


def follower(run: Path, log: Path, *options: str) -> subprocess.Popen[bytes]:
    words = ["view", str(run), "--follow", "--wait", "60", *options]
    with log.open("wb") as stream:
        return forge.start("plow_twin", words, stdout=stream, stderr=subprocess.STDOUT)


def test_a_stopped_viewer_does_not_disturb_the_node_and_catches_up_later(tmp_path: Path) -> None:
    port = free_port()
    run, log, file_log = tmp_path / "run", tmp_path / "view.log", tmp_path / "file.log"
    # one process sends to a viewer, the other writes a file
    shown = follower(run, log, "--web", "--web-port", str(port))
    written = follower(run, file_log, "--out", str(tmp_path / "run.rrd"))
    try:
        with bench(
            tmp_path, record_path=run, **{"qos_overrides.{ns}/excitation.subscription.reliability": "reliable"}
        ) as node:
            forces = node.probe.listen(JointState, "contact_forces")
            until(lambda: b"following" in log.read_bytes() and b"following" in file_log.read_bytes(), "followers")
            publisher = node.publisher("--seconds", "4")
            node.probe.until(lambda: len(forces) > 500, "a flow of messages")
            children = Path(f"/proc/{shown.pid}/task/{shown.pid}/children").read_text().split()
            viewer = int(children[0])
            for pid in (viewer, shown.pid):
                os.kill(pid, signal.SIGSTOP)
            until(lambda: stopped(viewer) and stopped(shown.pid), "both to stop")
            assert publisher.wait() == 0
            node.probe.until(lambda: len(forces) >= 4000, "every publication")
            recorder, output = node.probe.figures("recorder"), node.probe.figures("output")
            assert recorder["lost"] in ("", "0", "{}") and recorder["error"] == "" and output["withheld"] == "0"
            os.kill(shown.pid, signal.SIGCONT)  # the process continues, although nothing reads its messages
            assert node.twin.stop() == 0
        assert written.wait(WAIT_S) == 0
        reader = RunReader(run)
        assert [*reader.batches()] and not reader.lost
        published = reader.counts[f"{node.namespace}/contact_peaks"]
        assert f" of {published} read" in file_log.read_text() and published >= len(forces) >= 4000
        os.kill(viewer, signal.SIGCONT)
        until(lambda: b" read" in log.read_bytes(), "all to be shown")
        shown_rows = re.search(r" of (\d+) read", log.read_text())
        assert shown_rows is not None and int(shown_rows[1]) == published
        # the process is ended while the viewer does not respond
        os.kill(viewer, signal.SIGSTOP)
        shown.terminate()
        assert shown.wait(10.0) in (0, 1)
        until(lambda: not Path(f"/proc/{viewer}").exists(), "the viewer's end")
    finally:
        for process in (shown, written):
            process.kill()
            process.wait()
