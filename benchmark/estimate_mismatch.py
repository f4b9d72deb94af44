"""Errors and coverage of the estimate for machines that differ from the model, and the share of usable results.

    python benchmark/estimate_mismatch.py --truths 8 --seed 80000              # all kinds
    python benchmark/estimate_mismatch.py --kind friction_05 --truths 4

Each kind of machine differs from the model in one respect; machines of the kind `several` differ in most respects. The
true motion is simulated by `mismatched_machine.py`, which has its own equations and integrator. Each result is written
as soon as it is computed, and truths that are in the file are skipped.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")  # one thread, as in `Worker`

import click
import numpy as np
from estimate import RESULTS, completed
from estimate_truths import PERIOD, ROOT, cutting
from mismatched_machine import Machine, poses_of
from numpy.typing import NDArray

from plow_twin import Clearance, Contact, Scene
from plow_twin.estimate.estimate import estimate, warm_up
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import NORMAL_P95, State
from plow_twin.model.loads import compile_loads
from plow_twin.model.pairs import CORNER_X, CORNER_Y, NORMAL_X
from plow_twin.scene_file import load_scene

Array = NDArray[np.float64]

#: Sampling interval of the true load [s].
_FINE = 1e-3
#: Penetration [m] at which contacts with different exponents have equal forces.
_COMMON_DEPTH = 8e-3
#: Largest plausible component of a pose (m or rad). A larger component shows that the head has passed through a wall.
_LARGEST_TURN = 0.6
#: States of a clearance for which the estimate is published.
PUBLISHED = {"estimated", "rough"}
#: A published clearance is useful if its interval is narrower than this [m].
USEFUL_M = 4e-3


@dataclass(frozen=True)
class Kind:
    """Differences between a machine and the model.

    If the sign of a share or size is random, the number is a standard deviation.
    """

    title: str
    stiffness: tuple[float, float] = (5e6, 3e7)
    periods: float = 10.0
    noise_m: float = 5e-4
    rate_hz: float = 100.0
    #: Shape of the given load: paper, cutting (paper with a broad-band part), pressed, chatter or vertical.
    shape: str = "paper"
    gain: float = 0.05
    #: Correlated error of the load, as a share of the range of each component.
    correlated: float = 0.0
    #: Third harmonic in the error of the load, as a share of the range of each component.
    harmonic: float = 0.0
    #: Constant error of the load, as a share of the range of each component.
    constant: float = 0.0
    #: Length [s] of the averages in the given load; 0 for samples.
    averaged_s: float = 0.0
    #: Interval [s] of the samples in the given load, if `averaged_s` is 0.
    sampled_s: float = 0.01
    friction: float = 0.0
    exponent: float = 1.0
    walls: float = 0.0
    #: Relative difference between the true and the assumed mass.
    mass: float = 0.0
    #: Relative difference between the true and the assumed inertia.
    inertia: float = 0.0
    #: Difference [m] between the true and the assumed frame size.
    frame_m: float = 0.0
    spring: float = 0.0
    radius_m: float = 0.0
    askew_m: float = 0.0
    lever_m: float = 0.0
    filter_hz: float = 0.0
    steps_m: float = 0.0
    theta_missing: bool = False
    load_missing: bool = False
    theta_scale: float = 0.0
    clock: float = 0.0
    #: Number of bursts without poses. No threshold was tuned on this difference or on the following differences.
    bursts: int = 0
    #: Largest pose that the sensor can measure, as a share of the largest pose in the motion.
    saturated: float = 0.0
    #: Error of the arm of gravity [m].
    arm_m: float = 0.0
    #: Delay of the load [s].
    late_s: float = 0.0
    #: Drift of the bias of x and y over the window [m].
    drift_m: float = 0.0
    #: Change of the bias of x and y [m] by a temperature that rises and falls within the window.
    warm_m: float = 0.0
    #: Relative difference of the damping of each wall from the damping of the contact.
    damping_walls: float = 0.0
    #: Depth [m] of a recess in one wall.
    recess_m: float = 0.0
    #: Distance [m] of the centre of mass from its assumed place.
    off_centre_m: float = 0.0
    #: Angle [rad] between gravity and the assumed direction.
    inclination: float = 0.0
    #: Viscous drag on the head [N s/m].
    drag: float = 0.0
    #: Degrees of freedom of Student's distribution of the noise; 0 for normal noise.
    tails: int = 0
    #: Steps of theta [rad].
    theta_steps: float = 0.0
    #: Steps of the load, as a share of the range of each component.
    load_steps: float = 0.0
    #: Duration [s] of a burst without poses.
    burst_s: float = 0.3


_HARD = (1e9, 1e11)
_MILD = Kind(
    "mild", correlated=0.03, friction=0.02, exponent=1.03, walls=0.05, inertia=0.03, mass=0.02, frame_m=1e-3,
    radius_m=1e-3, lever_m=2e-3, filter_hz=20.0, theta_scale=3e-3,
)  # fmt: skip
KINDS = {
    "none": Kind("nothing"),
    "load_5": Kind("load: correlated error 5 %", correlated=0.05),
    "load_10": Kind("load: correlated error 10 %", correlated=0.10),
    "harmonic_1": Kind("load: third harmonic 1 %", harmonic=0.01),
    "harmonic_5": Kind("load: third harmonic 5 %", harmonic=0.05),
    "constant_1": Kind("load: constant 1 %", constant=0.01),
    "averages_1hz": Kind("load: averages of 1 Hz", averaged_s=1.0),
    "cutting_10hz": Kind("load: 10 Hz samples of cutting", shape="cutting", sampled_s=0.1),
    "friction_02": Kind("friction .02", friction=0.02),
    "friction_05": Kind("friction .05", friction=0.05),
    "friction_10": Kind("friction .1", friction=0.1),
    "exponent_105": Kind("exponent 1.05", exponent=1.05),
    "exponent_110": Kind("exponent 1.1", exponent=1.1),
    "walls_5": Kind("walls' stiffness +-5 %", walls=0.05),
    "walls_20": Kind("walls' stiffness +-20 %", walls=0.20),
    "frame": Kind("frame 2 mm", frame_m=2e-3),
    "mass": Kind("mass 5 %", mass=0.05),
    "inertia": Kind("inertia 5 %", inertia=0.05),
    "spring": Kind("frame on 4e8 N/m", spring=4e8),
    "corners": Kind("corners rounded 2 mm", radius_m=2e-3),
    "lever": Kind("lever arm of the sensor 5 mm", lever_m=5e-3),
    "filter_20": Kind("filter of the sensor 20 Hz", filter_hz=20.0),
    "filter_5": Kind("filter of the sensor 5 Hz", filter_hz=5.0),
    "steps": Kind("steps of 1 mm", steps_m=1e-3),
    "no_theta": Kind("theta missing", theta_missing=True),
    "no_load": Kind("load missing", load_missing=True),
    "theta_scale": Kind("theta's scale 1 %", theta_scale=0.01),
    "clock": Kind("clock drift 1e-4", clock=1e-4),
    "several": replace(_MILD, title="several mild ones", harmonic=0.005, constant=0.005),
    "several_stochastic": replace(_MILD, title="several mild ones, cutting load", shape="cutting"),
    "pressed": Kind("pressed to one side while cutting", shape="pressed"),
    "chatter": Kind("8 Hz chatter", shape="chatter"),
    "vertical": Kind("load vertical, x at rest", shape="vertical"),
    "bursts": Kind("bursts without poses", bursts=12),
    "saturated": Kind("sensor saturates at 0.9 of the motion", saturated=0.9),
    "arm": Kind("arm of gravity 10 mm", arm_m=0.01),
    "late_load": Kind("load 20 ms late", late_s=0.02),
    "drift": Kind("bias drifts by 1 mm", drift_m=1e-3),
    "warm": Kind("bias of 0.3 mm rises and falls", warm_m=3e-4),
    "damping_walls": Kind("walls' damping +-40 %", damping_walls=0.4),
    "recess": Kind("recess of 1 mm in one wall", recess_m=1e-3),
    "off_centre": Kind("centre of mass 3 mm off", off_centre_m=3e-3),
    "inclined": Kind("gravity inclined by 1 degree", inclination=np.radians(1.0)),
    "drag": Kind("viscous drag of 2 kN s/m", drag=2e3),
    "tails": Kind("noise with 3 degrees of freedom", tails=3),
    "theta_steps": Kind("theta in steps of 4 mrad", theta_steps=4e-3),
    "load_steps": Kind("load in steps of 2 %", load_steps=0.02),
    "dropouts": Kind("six gaps of 0.5 s in the poses", bursts=6, burst_s=0.5),
    "clock_200": Kind("clock drift 2e-4", clock=2e-4),
    "hard": Kind("hard: nothing", stiffness=_HARD),
    "hard_no_load": Kind("hard: load missing", stiffness=_HARD, load_missing=True),
    "hard_corners": Kind("hard: corners rounded 5 mm", stiffness=_HARD, radius_m=5e-3),
    "hard_askew": Kind("hard: pads askew 1 mm", stiffness=_HARD, askew_m=1e-3),
    "hard_theta": Kind("hard: theta's scale 1 %", stiffness=_HARD, theta_scale=0.01),
    "hard_friction": Kind("hard: friction .05", stiffness=_HARD, friction=0.05),
    "hard_harmonic": Kind("hard: load: third harmonic 5 %", stiffness=_HARD, harmonic=0.05),
}


@dataclass(frozen=True, eq=False)
class Mismatch:
    """A true machine and the inputs of the estimate."""

    scene: Scene
    nominal: Scene
    load: Load
    poses: Poses

    @property
    def clearance(self) -> Array:
        """The true clearances [m], shape (2,)."""
        return np.array([self.scene.clearance.horizontal_m, self.scene.clearance.vertical_m])


def draw(kind: Kind, seed: int) -> Mismatch:
    """Draw a machine whose head stays within its walls. A seed always gives the same machine."""
    attempts = (
        _draw(kind, np.random.default_rng([20261123, seed, *again])) for again in ((), *((i,) for i in range(1, 20)))
    )
    return next(attempt for attempt in attempts if np.nanmax(np.abs(attempt.poses.q)) < _LARGEST_TURN)


def _draw(kind: Kind, rng: np.random.Generator) -> Mismatch:
    nominal = load_scene(ROOT / "config" / "paper.yaml")
    end = kind.periods * PERIOD
    fine = np.arange(0.0, end + _FINE, _FINE)
    nominal_load = _believed(kind, nominal, rng, fine)
    if kind.shape == "vertical":
        nominal = replace(nominal, gravity=replace(nominal.gravity, arm_m=0.0))
    scene = _true_scene(kind, nominal, rng)
    machine = Machine(
        1.0 + kind.walls * _by_wall(rng),
        0.5 * kind.askew_m * rng.choice([-1.0, 1.0], 8),
        kind.radius_m,
        kind.friction,
        kind.spring,
        **_further(kind, rng),
    )
    wrench = _true_load(kind, rng, fine, nominal_load)
    t = np.arange(0.0, end, 1.0 / kind.rate_hz)
    poses, _ = Poses.of(*_measured(kind, rng, t, fine, poses_of(scene, machine, fine, wrench, fine)))
    load, _ = Load.of(*_telemetry(kind, fine, (not kind.load_missing) * nominal_load))
    return Mismatch(scene, nominal, load, poses)


def _further(kind: Kind, rng: np.random.Generator) -> dict[str, Any]:
    """Return the differences for which random numbers are drawn only in the kinds of machines that have them."""
    found: dict[str, Any] = {"drag": kind.drag}
    if kind.damping_walls:
        found["damping_share"] = 1.0 + kind.damping_walls * _by_wall(rng)
    if kind.recess_m:
        found["recess"] = kind.recess_m * (np.arange(8) == rng.integers(8))
    if kind.off_centre_m:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        found["off_centre"] = kind.off_centre_m * np.cos(angle), kind.off_centre_m * np.sin(angle)
    if kind.inclination:
        found["inclination"] = kind.inclination * rng.choice([-1.0, 1.0])
    return found


def _believed(kind: Kind, nominal: Scene, rng: np.random.Generator, t: Array) -> Array:
    paper = compile_loads(nominal.loads).at(t)
    noise = cutting(rng, t)
    if kind.shape == "cutting":
        return paper + noise * [8e3, 4e3, 1.1e4]
    if kind.shape == "pressed":
        # a constant force against one wall, plus broad-band noise
        return noise * [8e3, 4e3, 1.1e4] + [6e4, -5e3, 2e4]
    if kind.shape == "chatter":
        turn = 2.0 * np.pi * 8.0 * t
        return np.stack([2e4 * np.sin(turn), 3e4 * np.sin(turn + 0.5), 6e3 * np.sin(turn + 1.0)], axis=1)
    if kind.shape == "vertical":
        return np.stack([0.0 * t, 8e4 * np.sin(2.0 * t), 0.0 * t], axis=1)
    return paper


def _true_scene(kind: Kind, nominal: Scene, rng: np.random.Generator) -> Scene:
    low, high = np.log(kind.stiffness)
    stiffness = float(np.exp(rng.uniform(low, high)))
    clearance = Clearance(*rng.uniform(0.018, 0.034, 2))
    damping = 0.72 * float(np.exp(rng.normal(0.0, 0.4)))
    sign = rng.choice([-1.0, 1.0], 4)
    head, frame = nominal.head, nominal.frame
    return replace(
        nominal,
        clearance=clearance,
        contact=Contact(
            law="hunt_crossley",
            stiffness=stiffness * _COMMON_DEPTH ** (1.0 - kind.exponent),
            exponent=kind.exponent,
            damping=damping,
        ),
        gravity=replace(nominal.gravity, arm_m=nominal.gravity.arm_m + kind.arm_m * sign[0]),
        head=replace(
            head,
            mass_kg=head.mass_kg * (1.0 + kind.mass * sign[0]),
            inertia_kg_m2=head.inertia_kg_m2 * (1.0 + kind.inertia * sign[1]),
        ),
        frame=replace(
            frame, width_m=frame.width_m + kind.frame_m * sign[2], height_m=frame.height_m + kind.frame_m * sign[3]
        ),
    )


def _by_wall(rng: np.random.Generator) -> Array:
    """Return a sign for each pair, shape (8,). The two pairs of a wall have equal signs; the four walls do not."""
    signs: Array = rng.permutation([-1.0, -1.0, 1.0, 1.0])
    wall = np.where(NORMAL_X != 0.0, np.where(CORNER_X > 0.0, 0, 1), np.where(CORNER_Y > 0.0, 2, 3))
    return np.asarray(signs[wall], np.float64)


def _true_load(kind: Kind, rng: np.random.Generator, t: Array, nominal_load: Array) -> Array:
    size = np.ptp(nominal_load, axis=0) / 2.0
    slow = _correlated(rng, t)
    wrench = nominal_load * (1.0 + kind.gain * rng.standard_normal(3)) + kind.correlated * size * slow
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    wrench = wrench + kind.harmonic * size * np.sin(3.0 * 2.0 * np.pi / PERIOD * t[:, None] + phase)
    return np.asarray(wrench + kind.constant * size * rng.choice([-1.0, 1.0], 3))


def _correlated(rng: np.random.Generator, t: Array, time_s: float = 0.5) -> Array:
    """Return an Ornstein-Uhlenbeck process of unit variance, shape (n, 3)."""
    keep = np.exp(-(t[1] - t[0]) / time_s)
    drive = np.sqrt(1.0 - keep**2) * rng.standard_normal((len(t), 3))
    out: Array = np.zeros_like(drive)
    for index in range(1, len(t)):
        out[index] = keep * out[index - 1] + drive[index]
    return out


def _measured(kind: Kind, rng: np.random.Generator, t: Array, fine: Array, motion: Array) -> tuple[Array, Array]:
    turned = motion.copy()
    angle = rng.uniform(0.0, 2.0 * np.pi)
    arm = kind.lever_m * np.array([np.cos(angle), np.sin(angle)])
    c, s = np.cos(motion[:, 2]), np.sin(motion[:, 2])
    turned[:, 0] += c * arm[0] - s * arm[1] - arm[0]
    turned[:, 1] += s * arm[0] + c * arm[1] - arm[1]
    if kind.filter_hz:
        keep = np.exp(-2.0 * np.pi * kind.filter_hz * _FINE)
        for index in range(1, len(turned)):
            turned[index] = keep * turned[index - 1] + (1.0 - keep) * turned[index]
    q = np.stack([np.interp(t, fine, column) for column in turned.T], axis=1)
    q[:, 2] *= 1.0 + kind.theta_scale * rng.choice([-1.0, 1.0])
    white = rng.standard_t(kind.tails, q.shape) if kind.tails else rng.standard_normal(q.shape)
    q += kind.noise_m * np.array([1.0, 1.0, 4.0]) * white
    if kind.steps_m:
        step = kind.steps_m * np.array([1.0, 1.0, 4.0])
        q = np.round(q / step) * step
    if kind.theta_steps:
        q[:, 2] = np.round(q[:, 2] / kind.theta_steps) * kind.theta_steps
    if kind.saturated:
        most = kind.saturated * np.abs(motion[:, :2]).max(axis=0)
        q[:, :2] = np.clip(q[:, :2], -most, most)
    q[:, :2] += kind.drift_m * (t / t[-1] - 0.5)[:, None]
    q[:, :2] += kind.warm_m * np.sin(np.pi * t / t[-1])[:, None]
    for start in rng.uniform(0.0, t[-1], kind.bursts):
        q[(t >= start) & (t < start + kind.burst_s)] = np.nan
    if kind.theta_missing:
        q[:, 2] = np.nan
    return t * (1.0 + kind.clock), q


def _telemetry(kind: Kind, fine: Array, nominal_load: Array) -> tuple[Array, Array]:
    if kind.load_steps:
        step = kind.load_steps * np.ptp(nominal_load, axis=0)
        nominal_load = np.round(nominal_load / step) * step
    if not kind.averaged_s:
        knots = np.arange(0.0, fine[-1] + kind.sampled_s, kind.sampled_s)
        return knots + kind.late_s, np.stack([np.interp(knots, fine, column) for column in nominal_load.T], axis=1)
    rows = round(kind.averaged_s / _FINE)
    count = len(fine) // rows
    # the stamp of an average is the middle of its interval
    middle = fine[: count * rows].reshape(count, rows).mean(axis=1)
    return middle, nominal_load[: count * rows].reshape(count, rows, 3).mean(axis=1)


def run_one(name: str, seed: int) -> dict[str, Any]:
    truth = draw(KINDS[name], seed)
    begin = time.process_time()
    result = estimate(truth.nominal, truth.load, truth.poses)
    row: dict[str, Any] = {
        "kind": name, "seed": seed, "stiffness": truth.scene.contact.stiffness, "model": result.model,
        "sensor": result.sensor, "cpu_s": time.process_time() - begin, "reasons": "; ".join(result.reasons),
    }  # fmt: skip
    for axis, value, state, true in zip(
        "hv",
        (result.horizontal, result.vertical),
        (result.horizontal_state, result.vertical_state),
        truth.clearance.tolist(),
        strict=True,
    ):
        row |= {
            f"{axis}_error_m": value.mean - true,
            f"{axis}_sd_m": (value.p95 - value.p05) / (2.0 * NORMAL_P95),
            f"{axis}_inside": int(value.p05 <= true <= value.p95),
            f"{axis}_state": state.value,
        }
    return row | {f"figure_{key}": value for key, value in result.figures.items()}


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return the figures of a kind of machines, for both clearances together."""
    both = [
        {key: row[f"{axis}_{key}"] for key in ("error_m", "sd_m", "inside", "state")} for row in rows for axis in "hv"
    ]
    published = [entry for entry in both if entry["state"] in PUBLISHED]
    errors, all_errors = (np.array([entry["error_m"] for entry in some]) for some in (published, both))
    deviations = np.array([entry["sd_m"] for entry in published])
    useful = sum(2.0 * NORMAL_P95 * entry["sd_m"] < USEFUL_M for entry in published)
    return {
        "clearances": len(both),
        "published": len(published) / len(both),
        "useful": useful / len(both),
        "rmse_mm": 1e3 * float(np.sqrt(np.mean(errors**2))) if published else np.nan,
        "coverage": float(np.mean([entry["inside"] for entry in published])) if published else np.nan,
        "width_mm": 1e3 * 2.0 * NORMAL_P95 * float(np.median(deviations)) if published else np.nan,
        "far_off": float(np.mean(np.abs(errors) > 3.0 * deviations)) if published else 0.0,
        "all_rmse_mm": 1e3 * float(np.sqrt(np.mean(all_errors**2))),
        "withdrawn": float(np.mean([entry["state"] == State.WITHDRAWN.value for entry in both])),
        "cpu_s": float(np.mean([row["cpu_s"] for row in rows])),
    }


def as_markdown(groups: dict[str, dict[str, float]]) -> str:
    lines = [
        "| what differs | clearances | published | interval below 4 mm | RMSE [mm] | coverage | median width [mm] | "
        "beyond 3 deviations | CPU [s] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for title, row in groups.items():
        lines.append(
            f"| {title} | {row['clearances']} | {row['published']:.2f} | {row['useful']:.2f} | {row['rmse_mm']:.3f} | "
            f"{row['coverage']:.2f} | {row['width_mm']:.2f} | {row['far_off']:.2f} | {row['cpu_s']:.1f} |"
        )
    return "\n".join(lines).replace("nan", "-")


@click.command()
@click.option("--kind", "kinds", multiple=True, type=click.Choice(list(KINDS)))
@click.option("--truths", default=8, show_default=True)
@click.option("--seed", default=80000, show_default=True, help="First seed.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "estimate_mismatch.jsonl", show_default=True)
def main(kinds: tuple[str, ...], truths: int, seed: int, out: Path) -> None:
    warm_up(load_scene(ROOT / "config" / "paper.yaml"))
    names, seeds = kinds or tuple(KINDS), range(seed, seed + truths)
    rows = completed(out, ("kind", "seed"), ((name, number) for number in seeds for name in names), run_one)
    chosen_rows = [row for row in rows if row["seed"] in seeds and row["kind"] in names]
    groups = {KINDS[name].title: summary([row for row in chosen_rows if row["kind"] == name]) for name in names}
    click.echo(as_markdown(groups | {"all": summary(chosen_rows)}))


if __name__ == "__main__":
    main()
