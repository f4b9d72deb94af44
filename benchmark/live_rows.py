"""Rows of live twins with loads sampled at 1 kHz, and rows of starts with an empty and with a filled cache."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from bench_scenes import ROOT, SPARSE, T_END, bench_scene, constants, error_scale
from cases import Array, Row, pose_error, timed

from plow_twin import Scene, Table, Twin, TwinBatch, simulate

Notify = Callable[[str], None]
TOL = 1e-6
TWINS = 256
_TWIN, _TWINS = "plow_twin Twin", "plow_twin TwinBatch"


def sampled_rows(repeats: int, notify: Notify) -> Iterator[Row]:
    """Yield a row for one twin (`value`: multiple of real time), then rows for 256 twins (`value`: share of a core)."""
    scene, t = bench_scene("kv"), 1e-3 * np.arange(1.0, 20_001.0)
    p = constants(scene)
    wrench = np.sin(p[14] * t)[:, None] * p[11:14]
    notify("sampled load")
    yield _one_twin(scene, t, wrench, repeats)
    simulated_s = 1.0
    for samples in (10, 1):
        notify(f"{TWINS} twins, {samples} samples a call")
        rows = round(simulated_s * 1e3)
        walls = [_many_twins(scene, t[:rows], wrench[:rows], samples) for _ in range(repeats)]
        wall = float(np.median(walls))
        plural = "s" if samples > 1 else ""
        name = f"kv, 1 kHz, {TWINS} twins, {samples} sample{plural} a call"
        yield Row("sampled_load", name, _TWINS, f"tol={TOL:g}", 1e-3, simulated_s, 1e3 * wall, 1e3 * min(walls),
                  len(walls), value=wall / simulated_s)  # fmt: skip


def _one_twin(scene: Scene, t: Array, wrench: Array, repeats: int) -> Row:
    twin = Twin(scene, tol=TOL, excitation="sampled")
    twin.warm_up()
    walls = []
    for _ in range(repeats):
        twin.reset(0.0)
        wall, series = timed(lambda: twin.advance_samples(t, wrench))
        walls.append(wall)
    samples = Table("sampled", np.concatenate([[0.0], t]), np.concatenate([np.zeros((1, 3)), wrench]))
    exact = simulate(dataclasses.replace(scene, loads=(samples,)), T_END, SPARSE, 1e-12)
    median = float(np.median(walls))
    row = Row("sampled_load", "kv, 1 kHz, one twin", _TWIN, f"tol={TOL:g}", 1e-3, T_END, 1e3 * median, 1e3 * min(walls),
              repeats, steps=int(series.steps.sum()), events=int(series.makes.sum()), value=T_END / median)  # fmt: skip
    row.error = pose_error(exact.q[1:], error_scale(scene))(series.q[99::100])
    return row


def _many_twins(scene: Scene, t: Array, wrench: Array, samples: int) -> float:
    contacts = [
        dataclasses.replace(scene.contact, stiffness=scene.contact.stiffness * (1.0 + i / TWINS)) for i in range(TWINS)
    ]
    twins = TwinBatch([dataclasses.replace(scene, contact=contact) for contact in contacts], tol=TOL)
    twins.advance(1e-6)
    twins.reset(0.0)

    def run() -> None:
        for first in range(0, len(t), samples):
            twins.advance_samples(t[first : first + samples], wrench[first : first + samples])

    return timed(run)[0]


#: Program that prepares a live twin, and prints the duration and the numbers of kernels compiled and read from the
#: cache.
_START = """
import json, sys, time
begin = time.perf_counter()
from numba.core.dispatcher import Dispatcher
from plow_twin import Twin
from plow_twin.scene_file import load_scene
scene = load_scene(sys.argv[1])
imported = time.perf_counter()
Twin(scene, tol=1e-6, excitation="sampled").warm_up()
ready = time.perf_counter()
kernels = {
    id(kernel): kernel.stats
    for name, module in list(sys.modules.items()) if name.startswith("plow_twin")
    for kernel in vars(module).values() if isinstance(kernel, Dispatcher)
}
print(json.dumps({
    "import_s": imported - begin, "ready_s": ready - imported,
    "compiled": sum(sum(stats.cache_misses.values()) for stats in kernels.values()),
    "read": sum(sum(stats.cache_hits.values()) for stats in kernels.values()),
}))
"""


def start_rows(notify: Notify) -> Iterator[Row]:
    """Yield rows for a start with an empty cache and for the next start; `value` is the number of compiled kernels."""
    with tempfile.TemporaryDirectory() as cache:
        for name in ("cold start", "second start"):
            notify(name)
            yield _start_row(name, cache)


def _start_row(name: str, cache: str) -> Row:
    row = Row("start", f"paper, {name}", _TWIN, f"tol={TOL:g}")
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": os.pathsep.join(paths)}
    scene = Path(ROOT) / "config" / "paper.yaml"
    command = [sys.executable, "-c", _START, str(scene)]
    completed = subprocess.run(command, env=environment, capture_output=True, text=True)
    if completed.returncode != 0:
        row.status = f"failed: {completed.stderr.strip().splitlines()[-1]}"
        return row
    report = json.loads(completed.stdout)
    row.time([report["ready_s"]])
    row.value = float(report["compiled"])
    row.setting += f", import {report['import_s']:.2f} s, {report['read']} kernels read from the cache"
    return row
