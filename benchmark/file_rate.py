"""Rows per second that `plow-twin live` reads from a complete CSV file, without and with a recording.

    python benchmark/file_rate.py [--rows N]

The program prints a line of JSON for each case: rows per second of CPU time and of elapsed time, without the start.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

#: Number of rows of a short file, in which the start dominates.
FEW: Final = 1000


def write_load(path: Path, rows: int) -> None:
    """Write a CSV file with a load at 1 kHz that is similar to the load of the preset."""
    with path.open("w") as file:
        file.write("t,fx,fy,m\n")
        for index in range(rows):
            phase = math.sin(2e-3 * index)
            file.write(f"{1.7e9 + 1e-3 * index:.3f},{3e4 * phase:.1f},{-1e4 * phase:.1f},{-4e4 * phase:.1f}\n")


def measure(path: Path, *options: str) -> tuple[float, float]:
    """Return the CPU time and the elapsed time of a run [s]."""
    command = [sys.executable, "-m", "plow_twin", "live", str(path), "--scene", "paper", "--quiet", *options]
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run(command, check=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime, time.monotonic() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rows", type=int, default=1_000_000)
    rows = parser.parse_args().rows
    with tempfile.TemporaryDirectory() as folder:
        few, many = Path(folder, "few.csv"), Path(folder, "many.csv")
        write_load(few, FEW)
        write_load(many, rows)
        measure(few)  # this run may compile the solver, and is not measured
        for outputs in ("", "none", "all"):
            options = ["--set", f"record_outputs={outputs}", "--record"] if outputs else []
            start = measure(few, *options, *[f"{folder}/few_{outputs}"][: len(options)])
            whole = measure(many, *options, *[f"{folder}/many_{outputs}"][: len(options)])
            cpu, wall = ((rows - FEW) / (whole[place] - start[place]) for place in (0, 1))
            found = {"recorded": outputs or "nothing", "rows_per_cpu_s": round(cpu), "rows_per_s": round(wall)}
            print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
