"""Peak memory of the commands that read a recording: `python benchmark/command_memory.py [MINUTES ...]`.

The program records the paper's head with wear at 1 kHz, with a measured pose at 100 Hz, in a temporary folder. Then it
runs each command in a separate process. It prints one line of JSON for each command and length of the recording.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from file_rate import write_load

from plow_twin.model.scene import Wear
from plow_twin.run.twin import Twin
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.solve.state import ROW

_BATCH = 8192
#: Standard deviations of the measured pose: x, y [m], theta [rad].
_NOISE = (2e-5, 2e-5, 2e-5)
COMMANDS = {
    "view --png": ("view", "run", "--png", "picture.png"),
    "view": ("view", "run", "--out", "run.rrd"),
    "analyse --out": ("analyse", "run", "--out", "analysed"),
    "estimate": ("estimate", "measured"),
    "estimate by a mapping": ("estimate", "mapped", "--scene", "measured/scene.yaml"),
    "forecast": ("forecast", "run", "--limit-horizontal", "40", "--limit-vertical", "40"),
    "replay": ("replay", "run"),
}


def write_poses(path: Path, load: Path, count: int) -> None:
    twin, rng = Twin(load_scene("paper"), excitation="sampled"), np.random.default_rng(1)
    rows = np.zeros(_BATCH, ROW)
    with load.open() as loads, path.open("w") as file:
        loads.readline()
        file.write("t,x,y,theta\n")
        for begin in range(0, count, _BATCH):
            number = min(_BATCH, count - begin)
            table = np.loadtxt(loads, delimiter=",", max_rows=number, ndmin=2)
            stamps = np.arange(begin, begin + number, dtype=np.float64) * 1e-3
            twin.advance_rows(stamps, table[:, 1:].astype(np.float64), rows[:number])
            measured = rows["q"][:number:10] + rng.normal(0.0, _NOISE, (len(range(0, number, 10)), 3))
            for t, q in zip(table[::10, 0], measured, strict=True):
                file.write(f"{t:.3f},{q[0]:.6e},{q[1]:.6e},{q[2]:.6e}\n")


def run(folder: Path, *words: str) -> tuple[float, float]:
    """Run a command. Return its peak memory [MB] and processor time [s]."""
    command = [sys.executable, "-m", "plow_twin", *words, "--quiet"]
    _, status, used = os.wait4(os.spawnv(os.P_NOWAIT, sys.executable, command), 0)
    if os.waitstatus_to_exitcode(status) not in (0, 3):
        raise SystemExit(f"{' '.join(words)} in {folder}: exit code {os.waitstatus_to_exitcode(status)}")
    return used.ru_maxrss / 1e3, used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("minutes", type=int, nargs="*", default=[10, 60])
    scene = replace(load_scene("paper"), wear=Wear(1e-14, pad_area_m2=0.02, travel_speed_m_s=0.5))
    for minutes in parser.parse_args().minutes:
        with tempfile.TemporaryDirectory() as name:
            os.chdir(name)
            folder, count = Path(name), minutes * 60_000
            Path("measured").mkdir()
            write_load(folder / "measured/load.csv", count)
            write_poses(folder / "measured/pose.csv", folder / "measured/load.csv", count)
            Path("measured/scene.yaml").write_text(dump_scene(scene))
            recorded = run(folder, "live", "measured/load.csv", "--scene", "measured/scene.yaml", "--record", "run")
            Path("mapped").mkdir()
            Path("mapped/excitation.csv").symlink_to(folder / "measured/load.csv")
            Path("mapped/pose.csv").symlink_to(folder / "measured/pose.csv")
            for title, words in {"live --record": (), **COMMANDS}.items():
                memory, seconds = run(folder, *words) if words else recorded
                row = {"command": title, "minutes": minutes, "memory_mb": round(memory), "cpu_s": round(seconds, 1)}
                print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
