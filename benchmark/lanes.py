"""Compare runs in the SIMD lanes of `plow_twin.solve.lanes`, one or eight at a time, with the loop of a single scene.

    python benchmark/lanes.py [--tol 1e-6] [--rounds 9]

The runs alternate, so that other programs disturb all of them equally. The shortest CPU time of each is printed.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable

from bench_scenes import SPARSE, T_END, bench_scene
from work_precision import prepare_bare

from plow_twin import Contact, Friction, Scene
from plow_twin.run.ensemble import simulate_many


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
    for name, one in scenes.items():
        runs = (prepare_bare(one, SPARSE, tol), _in_lanes(one, 1, tol), _in_lanes(one, 8, tol))
        least = [float("inf")] * len(runs)
        for _ in range(chosen.rounds + 1):  # the first round compiles
            for i, run in enumerate(runs):
                begin = time.process_time()
                run()
                least[i] = min(least[i], time.process_time() - begin)
        loop, alone, eight = least[0], least[1], least[2] / 8
        print(f"{name}: loop {1e3 * loop:.2f} ms; alone in lanes {1e3 * alone:.2f} ms ({alone / loop:.2f});", end=" ")
        print(f"one of eight {1e3 * eight:.2f} ms ({eight / loop:.2f})")


if __name__ == "__main__":
    main()
