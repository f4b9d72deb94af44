"""Compare the speed of this checkout with an earlier commit.

    python benchmark/beside.py COMMIT [--rounds 5]

Each round runs the same work in two processes: one in a worktree of the commit, and one in this checkout. A process
warms up, repeats each case, and reports the shortest time of the case. The medians over all rounds and their ratio are
written to benchmark/results/beside.md.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import cases

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "benchmark" / "results" / "beside.md"
#: Program of a process: the cases of the README that both commits support. Pairs of clearances are simulated at the
#: first tolerance at which no pose differs by more than 1e-4 of the clearance from a run at a tolerance of 1e-12.
_WORK = """
import dataclasses, json, sys, time
import numpy as np
from plow_twin import Clearance, Twin, simulate
from plow_twin.run.ensemble import simulate_many
from plow_twin.scene_file import load_scene
from plow_twin.model.loads import compile_loads

def fastest(run, times=7):
    run()
    return min(run() for _ in range(times))

def sampled(scene, tol):
    t = np.arange(1, 20001) * 1e-3
    wrench = compile_loads(scene.loads).at(t)
    def run():
        twin = Twin(scene, excitation="sampled", tol=tol)
        begin = time.process_time()
        twin.advance_samples(t, wrench)
        return time.process_time() - begin
    return fastest(run, 3)

def pairs(scene):
    apart = np.linspace(0.020, 0.030, 32)
    scenes = [dataclasses.replace(scene, clearance=Clearance(float(x), float(y))) for x in apart for y in apart]
    half = np.hypot(scene.frame.width_m, scene.frame.height_m) / 2
    scale = np.array([(x, y, x / half) for x in apart for y in apart])[:, None]
    def at(tol):
        return simulate_many(scenes, 20.0, 0.1, tol, 1)
    exact = at(1e-12).q
    def good(tol):
        return np.max(abs(at(tol).q - exact) / scale) < 1e-4
    tol = next(tol for tol in (1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 1e-6) if good(tol))
    def run():
        begin = time.process_time()
        at(tol)
        return time.process_time() - begin
    return fastest(run, 3)

found = {}
for name in ("bench_kv", "bench_hc", "paper"):
    scene = load_scene(f"{sys.argv[1]}/config/{name}.yaml")
    for tol in (1e-3, 1e-6, 1e-9):
        found[f"{name}, 20 s, tolerance {tol:g}, output each 0.1 s"] = fastest(
            lambda: simulate(scene, 20.0, 0.1, tol=tol).wall_s
        )
    found[f"{name}, 20 s, tolerance 1e-6, output each 1 ms"] = fastest(
        lambda: simulate(scene, 20.0, 1e-3, tol=1e-6).wall_s
    )
    found[f"{name}, 20 s of samples at 1 kHz, tolerance 1e-6"] = sampled(scene, 1e-6)
    if name != "paper":
        found[f"{name}, 20 s of 1,024 clearance pairs, one core, each pose within 1e-4"] = pairs(scene)
print(json.dumps(found))
"""


def measure(tree: Path, cache: str) -> dict[str, float]:
    """Return the time [s] of each case, measured in a separate process."""
    environment = os.environ | {"PYTHONPATH": str(tree), "NUMBA_CACHE_DIR": cache}
    completed = subprocess.run(
        [sys.executable, "-c", _WORK, str(tree)], cwd=tree, env=environment, capture_output=True, text=True, check=True
    )
    times: dict[str, float] = json.loads(completed.stdout)
    return times


def table(commit: str, now: list[dict[str, float]], before: list[dict[str, float]]) -> str:
    lines = []
    for case in now[0]:
        old, new = (1e3 * statistics.median(times[case] for times in rounds) for rounds in (before, now))
        lines.append([case, f"{old:.3g} ms", f"{new:.3g} ms", f"{old / new:.2f}"])
    medians = cases.table(["work", f"`{commit}`", "this", "ratio"], lines)
    return f"Beside commit `{commit}`, {len(now)} rounds in turn:\n\n{medians}"


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("commit")
    arguments.add_argument("--rounds", type=int, default=5)
    chosen = arguments.parse_args()
    commit = _git("rev-parse", "--short", chosen.commit)
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        _git("worktree", "add", "--detach", str(tree), commit)
        try:
            before: list[dict[str, float]] = []
            now: list[dict[str, float]] = []
            for number in range(chosen.rounds):
                print(f"round {number + 1} of {chosen.rounds}", file=sys.stderr)
                both = (before, tree, "before"), (now, ROOT, "now")
                # the second process of a round runs on a warmer machine, so the order alternates
                for times, place, cache in both if number % 2 == 0 else reversed(both):
                    times.append(measure(place, f"{folder}/{cache}"))
        finally:
            _git("worktree", "remove", "--force", str(tree))
    text = table(commit, now, before)
    print(text)
    PAGE.write_text(f"{text}\n", encoding="utf-8")


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    main()
