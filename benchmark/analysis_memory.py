"""Memory that the analysis of a run of some hours needs: `python benchmark/analysis_memory.py [HOURS]`.

Rows at 1 kHz are computed once and fed to the analysis repeatedly, as in a long `--watch`.
"""

from __future__ import annotations

import resource
import sys
from dataclasses import replace

import numpy as np

from plow_twin.record.walking import Walked, Walker
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.session import Session
from plow_twin.study.analysis.analyse import Prediction
from plow_twin.study.analysis.loads import LoadTotals

_BATCH = 4096


def main() -> None:
    """Print the largest memory of the process after each hour."""
    hours = int(sys.argv[1]) if len(sys.argv) > 1 else 4
    scene = load_scene(scene_path("paper"))
    prediction = Prediction("paper", scene, LoadTotals(scene))
    found: list[Walked] = []
    walker = Walker(Session(Twin(scene, excitation="sampled")), found.append)
    stamps = 1_000_000 * np.arange(1, _BATCH + 1, dtype=np.int64)
    wrench = np.sin(2e-9 * stamps)[:, None] * np.array([32_000.0, -11_000.0, -45_495.0])
    walker.samples(stamps, wrench, stamps)
    per_hour = round(3600e3 / _BATCH)
    for number in range(hours * per_hour):
        prediction.walked(replace(found[0], stamp_ns=stamps + number * stamps[-1]))
        if (number + 1) % per_hour == 0:
            most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"{(number + 1) // per_hour} h: {most:.0f} MiB, one row in {prediction.stride} kept", flush=True)


if __name__ == "__main__":
    main()
