"""Random scenes from a seed, and their reference trajectories, computed by `reference.c` in extended precision.

`python benchmark/random_scenes.py` draws the scenes and computes the references again. It needs gcc with libquadmath.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from native import FLAGS, compile_c
from numpy.typing import NDArray
from rich.progress import track

from plow_twin import Clearance, Contact, Frame, Gravity, Harmonic, Head, Initial, Scene
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.geometry import half_diagonal, length_scale

HERE = Path(__file__).resolve().parent
DATA = HERE / "data" / "random_scenes.npz"
COUNT, SEED = 200, 20150419
T_END, OUTPUT_DT = 1.0, 0.02
#: Tolerance of a step, and longest step in contact, of the two reference runs in each arithmetic.
LONG_DOUBLE = (1e-16, 0.6), (1e-15, 1.0)
QUAD = (1e-21, 0.6), (1e-19, 1.0)
#: Largest difference between the two runs, relative to the clearance, without a repetition in 113-bit arithmetic.
AGREED = 1e-11
PERTURBATION = 1e-12
_KINDS = {"kelvin_voigt": 0, "hunt_crossley": 1, "exact_restitution": 2}


@dataclass(frozen=True)
class ReferenceRun:
    """A reference trajectory with poses `q`, shape (rows, 3), and its cost."""

    q: NDArray[np.float64]
    finished: bool
    steps: int
    evaluations: int
    events: int


@dataclass(frozen=True)
class RandomScenes:
    """The scenes with reference poses `q`, shape (n, rows, 3), at the times `t`, shape (rows,).

    `disagreement`, shape (n,), is the largest distance between the two reference runs (see `distance`).
    `amplification`, shape (n,), is the growth of a displacement of 1e-12 clearances at t = 0.
    """

    scenes: Sequence[Scene]
    t: NDArray[np.float64]
    q: NDArray[np.float64]
    disagreement: NDArray[np.float64]
    amplification: NDArray[np.float64]
    events: NDArray[np.int64]

    def chaotic(self, tol: float) -> NDArray[np.bool_]:
        """Return a mask of the scenes without a reference for `tol`: their runs differ by a tenth of it or more."""
        return ~(self.disagreement <= 0.1 * tol)


def distance(scene: Scene, q: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Return the largest pose error relative to the smaller clearance. Angles are multiplied by half the diagonal."""
    scale = np.array([1.0, 1.0, half_diagonal(scene)]) / length_scale(scene)
    return float((np.abs(q - reference) * scale).max())


def draw_scene(rng: np.random.Generator) -> Scene:
    """Draw a scene whose contact is not too soft."""
    while True:
        parameters = _draw(rng)
        head, frame, contact = parameters["head"], parameters["frame"], parameters["contact"]
        force = sum(float(np.hypot(*load.force_n)) for load in parameters["loads"]) + 9.81 * head.mass_kg
        depth = (force / contact.stiffness) ** (1.0 / contact.exponent)
        if depth < 0.02 * min(frame.width_m, frame.height_m):
            return Scene(**parameters)


def _draw(rng: np.random.Generator) -> dict[str, Any]:
    def logarithmic(low: float, high: float) -> float:
        return float(10.0 ** rng.uniform(np.log10(low), np.log10(high)))

    def uniform(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    width, height, mass = uniform(0.15, 0.8), uniform(0.15, 0.8), logarithmic(20.0, 5000.0)
    offset = (uniform(-0.1, 0.1), uniform(-0.1, 0.1)) if rng.random() < 0.3 else (0.0, 0.0)
    size = float(np.hypot(width, height))
    loads = []
    for name in ("first", "second")[: int(rng.integers(1, 3))]:
        level = mass * 9.81 * logarithmic(0.1, 3.0)
        angle = uniform(0.0, 2.0 * np.pi)
        force = (level * float(np.cos(angle)), level * float(np.sin(angle)))
        at = (uniform(-size, size), uniform(-size, size))
        loads.append(Harmonic(name, force, logarithmic(1.0, 30.0), uniform(0.0, 2.0 * np.pi), 0.0, at))
    return {
        "head": Head(mass, mass * (size * uniform(0.3, 1.5)) ** 2, "consistent" if any(offset) else "paper", offset),
        "frame": Frame(width, height),
        "clearance": Clearance(logarithmic(2e-3, 0.05), logarithmic(2e-3, 0.05)),
        "contact": _draw_contact(rng, mass),
        "gravity": Gravity(9.81, 0.0 if any(offset) else uniform(-0.2, 0.2)),
        "loads": tuple(loads),
        "initial": Initial(v=(uniform(-0.3, 0.3), uniform(-0.3, 0.3), uniform(-0.3, 0.3))),
    }


def _draw_contact(rng: np.random.Generator, mass: float) -> Contact:
    law = str(rng.choice(list(_KINDS)))
    stiffness = float(10.0 ** rng.uniform(5.0, 11.0))
    if law == "kelvin_voigt":
        ratio = float(10.0 ** rng.uniform(-2.0, 0.3))
        return Contact(law, stiffness, 1.0, damping=2.0 * ratio * float(np.sqrt(stiffness * mass)))
    exponent = float(rng.choice([1.0, 1.5, 2.0]))
    if law == "hunt_crossley":
        return Contact(law, stiffness, exponent, damping=float(rng.uniform(0.0, 2.0)))
    return Contact(law, stiffness, exponent, restitution=float(rng.uniform(0.1, 1.0)))


def reference_line(scene: Scene, t_end: float, output_dt: float) -> str:
    """Return the scene as a line of numbers for `reference.c`."""
    contact, law = scene.contact, LAWS[scene.contact.law]
    kind = _KINDS[contact.law]
    damping = contact.damping if contact.restitution is None else law.damping_number(contact.restitution)
    numbers: list[float] = [
        scene.frame.width_m, scene.frame.height_m, scene.clearance.horizontal_m, scene.clearance.vertical_m,
        scene.head.mass_kg, scene.head.inertia_kg_m2, scene.gravity.acceleration_m_s2, scene.gravity.arm_m,
        *scene.head.com_offset_m, contact.stiffness, contact.exponent, damping or 0.0, contact.impact_speed_floor_m_s,
        kind, t_end, output_dt, *scene.initial.q, *scene.initial.v, len(scene.loads),
    ]  # fmt: skip
    for load in scene.loads:
        if not isinstance(load, Harmonic):
            raise ValueError(f"load {load.name!r}: got a {type(load).__name__}, expected a Harmonic")
        x, y = load.at_m
        moment = load.moment_n_m + x * load.force_n[1] - y * load.force_n[0]
        numbers += [*load.force_n, load.omega_rad_s, load.phase_rad, moment]
    return " ".join(repr(float(number)) for number in numbers)


def reference_run(
    scene: Scene,
    t_end: float,
    output_dt: float,
    setting: tuple[float, float],
    perturbation: float = 0.0,
    *,
    quad: bool = False,
) -> ReferenceRun:
    """Run the reference program on one scene, with a mantissa of 64 bits, or of 113 bits if `quad`."""
    program = (
        compile_c("reference.c", ["-lquadmath", "-lm"], (*FLAGS, "-DQUAD"))
        if quad
        else compile_c("reference.c", ["-lm"])
    )
    line = reference_line(scene, t_end, output_dt).encode()
    output = subprocess.run(
        [program, *map(repr, setting), repr(perturbation)], input=line, capture_output=True, check=True
    )
    numbers = np.frombuffer(output.stdout)
    status, steps, evaluations, events, rows = (int(number) for number in numbers[:5])
    return ReferenceRun(numbers[5:].reshape(rows, 3), status == 0, steps, evaluations, events)


def make() -> None:
    """Draw the scenes, compute their references, and write both to `DATA`."""
    rng = np.random.default_rng(SEED)
    scenes = [draw_scene(rng) for _ in range(COUNT)]
    rows = round(T_END / OUTPUT_DT) + 1

    def one(scene: Scene) -> tuple[NDArray[np.float64], float, float, int]:
        fine, coarse = (reference_run(scene, T_END, OUTPUT_DT, setting) for setting in LONG_DOUBLE)
        moved = reference_run(scene, T_END, OUTPUT_DT, LONG_DOUBLE[1], PERTURBATION)
        amplification = (
            distance(scene, moved.q, coarse.q) / PERTURBATION if moved.finished and coarse.finished else np.nan
        )
        if not (fine.finished and coarse.finished) or distance(scene, coarse.q, fine.q) > AGREED:
            fine, coarse = (reference_run(scene, T_END, OUTPUT_DT, setting, quad=True) for setting in QUAD)
        if not (fine.finished and coarse.finished):
            return np.full((rows, 3), np.nan), np.nan, amplification, fine.events
        return fine.q, distance(scene, coarse.q, fine.q), amplification, fine.events

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        runs = list(track(pool.map(one, scenes), "references", COUNT))
    q, disagreement, amplification, events = (np.array(column) for column in zip(*runs, strict=True))
    lines = [reference_line(scene, T_END, OUTPUT_DT) for scene in scenes]
    restitution = [scene.contact.restitution for scene in scenes]
    np.savez_compressed(
        DATA, t=np.arange(rows) * OUTPUT_DT, q=q, disagreement=disagreement, amplification=amplification, events=events,
        lines=np.array(lines), restitution=json.dumps(restitution),
    )  # fmt: skip


def load() -> RandomScenes:
    with np.load(DATA) as saved:
        restitution = json.loads(str(saved["restitution"]))
        scenes = [_scene_of(line, e) for line, e in zip(saved["lines"], restitution, strict=True)]
        return RandomScenes(
            scenes, saved["t"], saved["q"], saved["disagreement"], saved["amplification"], saved["events"]
        )


def _scene_of(line: str, restitution: float | None) -> Scene:
    """Return the scene of a line from `reference_line`, which contains all parameters except the restitution."""
    n = [float(word) for word in line.split()]
    law = list(_KINDS)[int(n[14])]
    damping = n[12] if restitution is None else None
    loads = []
    for i in range(int(n[23])):
        fx, fy, omega, phase, moment = n[24 + 5 * i : 29 + 5 * i]
        loads.append(Harmonic(f"load {i + 1}", (fx, fy), omega, phase, moment))
    return Scene(
        head=Head(n[4], n[5], "consistent" if any(n[8:10]) else "paper", (n[8], n[9])),
        frame=Frame(n[0], n[1]),
        clearance=Clearance(n[2], n[3]),
        contact=Contact(law, n[10], n[11], damping=damping, restitution=restitution, impact_speed_floor_m_s=n[13]),
        gravity=Gravity(n[6], n[7]),
        loads=tuple(loads),
        initial=Initial((n[17], n[18], n[19]), (n[20], n[21], n[22])),
    )


if __name__ == "__main__":
    make()
