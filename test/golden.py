"""Motions whose results are pinned by hashes, bit for bit.

    python test/golden.py [NAME ...]

computes these motions, or all motions, and prints their figures as JSON.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np
from scenes import preset
from shared_work import compile_once
from test_solve_flight import swaying
from test_solve_implicit import damped
from test_solve_rest import fallen

from plow_twin import Contact, Friction, Scene, Twin, TwinBatch, Wear, simulate
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.loads import compile_loads

Figures = dict[str, Any]

#: Damping of the laws that have this parameter, for the head of a bench scene.
_DAMPING = {"kelvin_voigt": 6e4, "ramped_damping": 6e4}


def build_name() -> str:
    """Return a name of the compiler and the mathematical libraries, on which the bits of a result depend.

    The hashes are equal on AMD Zen 3 and on Intel Xeons with AVX-512. The motion with friction has a second hash, for
    the code that LLVM generates for Zen 4 and Zen 5.
    """
    libc = "".join(platform.libc_ver())
    return f"numba{version('numba')}-numpy{version('numpy')}-{libc}"


def _digest(arrays: Iterable[Any]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _law(name: str) -> Scene:
    law = LAWS[name]
    scene = preset("bench_hc" if law.exponent != 1.0 else "bench_kv")
    damping = _DAMPING.get(name)
    contact = Contact(
        name, 2e7 if law.exponent == 1.0 else 1e8, law.exponent or 1.5, damping=damping,
        restitution=0.4 if law.takes_restitution else None, ramp_m=1e-3 if law.ramped else None,
    )  # fmt: skip
    return replace(scene, contact=contact)


def _run(scene: Scene, t_end: float = 2.0, **options: Any) -> Figures:
    result = simulate(scene, t_end, output_dt=options.pop("output_dt", t_end / 100.0), **options)
    events = [result.events[name] for name in ("time", "pair", "mode_from", "mode_to", "rate")]
    sums = [list(table.values()) for table in result.statistics.values()]
    arrays = (result.q, result.v, result.force, result.penetration, *events, sums, result.wear_depth)
    counts = {name: result.solver[name] for name in ("steps", "evaluations", "events")}
    return {"digest": _digest(arrays), **counts}


def _stream(scene: Scene, **options: Any) -> Figures:
    times = np.arange(1, 1001) * 1e-3
    twin = Twin(scene, excitation="sampled", **options)
    rows = twin.advance_samples(times, compile_loads(preset("bench_kv").loads).at(times))
    arrays = (rows.q, rows.v, rows.penetration, rows.rate, rows.force, rows.peak, rows.impulse, rows.wear_depth)
    return {"digest": _digest(arrays), "steps": twin.steps, "evaluations": twin.evaluations, "bounded": twin.bounded}


def _batch() -> Figures:
    times = np.arange(1, 501) * 1e-3
    scene = preset("bench_kv")
    wider = replace(scene, clearance=replace(scene.clearance, horizontal_m=0.028))
    wrench = np.stack([compile_loads(scene.loads).at(times)] * 2)
    rows = TwinBatch([scene, wider]).advance_samples(times, wrench)
    return {"digest": _digest((rows.q, rows.v, rows.force, rows.peak, rows.impulse)), "steps": int(rows.steps.sum())}


CASES: dict[str, Callable[[], Figures]] = {
    **{f"law {name}": (lambda name=name: _run(_law(name))) for name in LAWS},
    "exponent 1": lambda: _run(preset("paper")),
    "loose tolerance": lambda: _run(preset("bench_kv"), tol=1e-3),
    "friction": lambda: _run(replace(preset("bench_kv"), friction=Friction(0.2, 0.02)), 0.5),
    "wear": lambda: _run(replace(preset("bench_kv"), wear=Wear(1e-11, 0.015, 2.0))),
    "overdamped": lambda: _run(damped(1e9), 0.5, energy_balance=True),
    "free flight": lambda: _run(swaying(), 3600.0),
    "rest": lambda: _run(fallen(), 600.0, energy_balance=True),
    "fixed steps": lambda: _run(preset("paper"), method="rk4", dt=1e-4, output_dt=0.1),
    "energy": lambda: _run(preset("bench_kv"), energy_balance=True),
    "samples": lambda: _stream(preset("bench_kv")),
    "samples, bounded": lambda: _stream(preset("bench_kv"), max_evaluations=200),
    "batch": _batch,
}


if __name__ == "__main__":
    compile_once()
    print(json.dumps({name: CASES[name]() for name in sys.argv[1:] or CASES}))
