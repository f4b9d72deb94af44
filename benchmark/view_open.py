"""Time and memory that rerun's viewer needs to show a recording: `python benchmark/view_open.py RUN.rrd SECONDS`.

The viewer shows the time SECONDS after the first stamp. The memory is the resident memory of the viewer's processes.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tools"))

from screenshot import connect, start_viewer

from plow_twin.view.viewer import free_port


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process and its children [MB]."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8").split()
    texts = [Path(f"/proc/{number}/status").read_text(encoding="utf-8") for number in (pid, *children)]
    lines = [line for text in texts for line in text.splitlines() if line.startswith("VmRSS")]
    return sum(int(line.split()[1]) for line in lines) * 1.024e-3


def main() -> None:
    file, at_s = Path(sys.argv[1]).resolve(), float(sys.argv[2])
    with tempfile.TemporaryDirectory() as home:
        measure(file, at_s, Path(home))


def measure(file: Path, at_s: float, home: Path) -> None:
    """Open the file in a viewer with its settings in the folder `home`, and print times and memory."""
    port = free_port()
    viewer = start_viewer(port, home)
    try:
        client = connect(port)
        time.sleep(2.0)
        empty, begin = resident_mb(viewer.pid), time.monotonic()
        client.open(str(file))
        opened = time.monotonic() - begin
        client.set_time("run_time", duration=at_s, play_state="paused")
        client.take_screenshot()
        shown = time.monotonic() - begin
        time.sleep(6.0)
        full = resident_mb(viewer.pid)
        print(f"opened in {opened:.1f} s, shown after {shown:.1f} s; {empty:.0f} MB empty, {full:.0f} MB")
    finally:
        os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait()


if __name__ == "__main__":
    main()
