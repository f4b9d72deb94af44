"""Time and memory of `compare` for a month of runs: `python benchmark/compare_month.py FOLDER`.

With `--hours 0.5 --rate 100 --verb analyse`, the program measures `analyse` for many short runs. It computes ten
minutes of motion once, and the run of each day repeats them with its own stamps.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from pathlib import Path

import click
import numpy as np

from plow_twin.record.header import RunHeader
from plow_twin.record.walking import Walked, Walker
from plow_twin.record.writer import RunWriter
from plow_twin.run.twin import Twin
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import Session

_BEGIN_NS = 1_796_083_200 * 10**9  # 2026-12-01
_DAY_S, _SPAN_S = 86_400, 600


def write_days(folder: Path, days: int, hours: float, rate_hz: float) -> None:
    scene = load_scene("paper")
    count = round(_SPAN_S * rate_hz)
    stamps = np.round(1e9 / rate_hz * np.arange(count)).astype(np.int64)
    seconds = stamps * 1e-9
    swing = np.sin(2.0 * seconds) * np.interp(seconds, np.arange(0.0, 2.0 * _SPAN_S, np.pi), _heights())
    wrench = swing[:, None] * np.array([32_000.0, -11_000.0, -45_495.0])
    walked: list[Walked] = []
    Walker(Session(Twin(scene, excitation="sampled")), walked.append).samples(stamps, wrench, stamps)
    published = Published.joined([part.published for part in walked])
    header = RunHeader(dump_scene(scene), parameters={"scene": "paper"})
    for day in range(days):
        place = folder / f"day_{day:02}"
        if place.exists():
            continue
        writer = RunWriter(place, header, 2**20, 0)
        for number in range(round(3600 * hours / _SPAN_S)):
            shift = _BEGIN_NS + (day * _DAY_S + number * _SPAN_S) * 10**9
            rows, slow = published.rows.copy(), published.slow.copy()
            rows["stamp_ns"] += shift
            slow["stamp_ns"] += shift
            sequence = number * count + np.arange(count)
            writer.write_samples(sequence, stamps + shift, stamps + shift, wrench)
            writer.write_publications(sequence, stamps + shift, Published(rows, slow))
        writer.close({})


def _heights() -> np.ndarray:
    return np.random.default_rng(1).normal(1.0, 0.08, len(np.arange(0.0, 2.0 * _SPAN_S, np.pi)))


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--days", default=30, show_default=True)
@click.option("--hours", default=24.0, show_default=True, help="Length of a day's run.")
@click.option("--rate", default=1.0, show_default=True, help="Samples of the load per second.")
@click.option("--verb", type=click.Choice(["compare", "analyse"]), default="compare", show_default=True)
@click.option("--workers", default=1, show_default=True)
def main(folder: Path, days: int, hours: float, rate: float, verb: str, workers: int) -> None:
    write_days(folder, days, hours, rate)
    runs = [str(folder / f"day_{day:02}") for day in range(days)]
    command = [sys.executable, "-m", "plow_twin", verb, *runs, "--workers", str(workers), "--quiet"]
    command += ["--by", "day"] if verb == "compare" else []
    begin = time.monotonic()
    subprocess.run([*command, "--out", str(folder / "out")], check=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    click.echo(
        f"{days} runs of {round(3600 * hours * rate)} samples: {used.ru_utime + used.ru_stime:.0f} s of CPU, "
        f"{time.monotonic() - begin:.0f} s, largest process {used.ru_maxrss / 1024:.0f} MiB"
    )


if __name__ == "__main__":
    main()
