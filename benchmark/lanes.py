"""Compare runs in the SIMD lanes of `plow_twin.solve.lanes`, one or eight at a time, with the loop of a single scene.

    python benchmark/lanes.py [--tol 1e-6] [--rounds 9]

The runs alternate, so that other programs disturb all of them equally. The shortest CPU time of each is written to
benchmark/results/lanes.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import cases
from bench_scenes import SPARSE, T_END, bench_scene
from work_precision import prepare_bare

from plow_twin import Contact, Friction, Scene
from plow_twin.run.ensemble import simulate_many

PAGE = Path(__file__).resolve().parent / "results" / "lanes.md"


def _in_lanes(scene: Scene, count: int, tol: float) -> Callable[[], object]:
    return lambda: simulate_many([scene] * count, T_END, SPARSE, tol, 1)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--tol", type=float, default=1e-6)
    arguments.add_argument("--rounds", type=int, default=9)
    chosen = arguments.parse_args()
    scene, tol = bench_scene("kv"), chosen.tol
    linear = Contact("hunt_crossley", scene.contact.stiffness, 1.0, damping=1.0)
    scenes = {"kv": scene, "hc, n = 1": dataclasses.replace(scene, contact=linear), "hc": bench_scene("hc")}
    scenes |= {f"{name}, friction": dataclasses.replace(scenes[name], friction=Friction(0.1)) for name in ("kv", "hc")}
    lines = []
    for name, one in scenes.items():
        runs = (prepare_bare(one, SPARSE, tol), _in_lanes(one, 1, tol), _in_lanes(one, 8, tol))
        least = [float("inf")] * len(runs)
        for _ in range(chosen.rounds + 1):  # the first round compiles
            for i, run in enumerate(runs):
                begin = time.process_time()
                run()
                least[i] = min(least[i], time.process_time() - begin)
        loop, alone, eight = 1e3 * least[0], 1e3 * least[1], 1e3 * least[2] / 8
        lines.append([
            name, f"{loop:.3g} ms", f"{alone:.3g} ms", f"{alone / loop:.2f}", f"{eight:.3g} ms", f"{eight / loop:.2f}"
        ])  # fmt: skip
    head = ["scene", "loop", "alone in lanes", "ratio", "one of eight", "ratio"]
    text = f"{T_END:g} s, tolerance {tol:g}, {cases.machine_name()}:\n\n{cases.table(head, lines)}"
    print(text)
    PAGE.write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
