"""Synthetic truths for the estimate: a scene, its motion, and measurements by a sensor and load telemetry.

The true motion is simulated with a tolerance and load samples that differ from those of the estimate. In the groups
outside the model, the contact law, load shape, sensor or machine contradicts the assumptions of the estimate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plow_twin import Clearance, Contact, Initial, Scene, Table, Wear, simulate
from plow_twin.estimate.contact_forces import ContactForces
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.model.loads import compile_loads
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Friction
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.stream.outputs import clearances

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
#: Load period of the paper's scene [s].
PERIOD = np.pi
#: Sampling interval of the true load [s].
_FINE = 1e-3
#: Share of the window after which a shift, a jam or a fault of the sensor begins.
_FROM = 0.55


@dataclass(frozen=True)
class Group:
    """Parameters from which the truths of a group are drawn."""

    title: str
    noise_m: float = 5e-4
    rate_hz: float = 100.0
    periods: float = 10.0
    stiffness: tuple[float, float] = (5e6, 3e7)
    law: str = "hunt_crossley"
    exponent: float = 1.0
    load_error: float = 0.05
    bias_m: float = 0.0
    delay_s: float = 0.0
    gaps: bool = False
    stochastic: bool = False
    load_step: float = 0.01
    third_harmonic: float = 0.0
    load_scale: float = 1.0
    friction: float = 0.0
    jam_m: float = 0.0
    shift_m: float = 0.0
    stuck: bool = False
    noisier: float = 1.0
    #: Ratio of the measured to the true value of x, y and theta.
    sensor_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    #: Whether x and y are exchanged.
    swapped: bool = False
    #: Wear coefficient of the truth [m^2/N]. The estimate assumes no wear.
    wear_m2_n: float = 0.0
    #: Sampling rate [Hz] of the load cells at all pairs; 0 without load cells.
    forces_hz: float = 0.0
    #: Standard deviation of the noise of the load cells [N].
    forces_noise_n: float = 1e3
    #: Standard deviation of the gain error of each load cell.
    forces_gain: float = 0.05
    #: Largest delay of the load cells [s].
    forces_delay_s: float = 0.05
    #: Change of the paper's scene to the scene that the estimate is told.
    machine: Callable[[Scene], Scene] | None = None
    #: Expected verdict on the model.
    model: str = "ok"
    #: Expected verdict on the sensor.
    sensor: str = "ok"


GROUPS = {
    "plain": Group("0.5 mm, 100 Hz, load to 5 %"),
    "sensor": Group("with bias, delay, gaps, missing components", bias_m=1e-3, delay_s=0.05, gaps=True),
    "quiet": Group("0.2 mm", noise_m=2e-4),
    "noisy": Group("2 mm", noise_m=2e-3),
    "slow": Group("10 Hz", rate_hz=10.0),
    "stochastic": Group("stochastic load", stochastic=True, load_step=2e-3),
    "coarse_load": Group("stochastic load, sampled at 100 Hz", stochastic=True),
    "worn": Group("wear of some 0.1 mm in the window", wear_m2_n=5e-13),
    "middle": Group("K 3e7 .. 3e8", stiffness=(3e7, 3e8)),
    "firm": Group("K 3e8 .. 1e9", stiffness=(3e8, 1e9)),
    "hard": Group("K 1e9 .. 1e11", stiffness=(1e9, 1e11)),
    "hard_sensor": Group("hard, with bias, delay, gaps", stiffness=(1e9, 1e11), bias_m=5e-3, delay_s=0.05, gaps=True),
    "forces": Group("with measured forces, 1 kHz", forces_hz=1e3),
    "forces_slow": Group("with measured forces, 100 Hz", forces_hz=100.0),
    "noisy_forces": Group("2 mm, with measured forces, 1 kHz", noise_m=2e-3, forces_hz=1e3),
    "forces_kelvin_voigt": Group(
        "truth: Kelvin-Voigt, with measured forces", law="kelvin_voigt", forces_hz=1e3, model="suspect"
    ),
    "kelvin_voigt": Group("truth: Kelvin-Voigt", law="kelvin_voigt", model="suspect"),
    "hard_kelvin_voigt": Group("hard, truth: Kelvin-Voigt", stiffness=(1e9, 1e11), law="kelvin_voigt", model="suspect"),
    "hard_20": Group("K 1e9 .. 1e11, 20 periods", stiffness=(1e9, 1e11), periods=20.0),
    "hard_kelvin_voigt_20": Group(
        "hard, Kelvin-Voigt, 20 periods", stiffness=(1e9, 1e11), law="kelvin_voigt", periods=20.0, model="suspect"
    ),
    "hard_shape": Group("hard, truth: third harmonic", stiffness=(1e9, 1e11), third_harmonic=0.15, model="suspect"),
    "exponent": Group("truth: exponent 1.5", exponent=1.5, stiffness=(5e7, 3e8), model="suspect"),
    "shape": Group("truth: third harmonic of 15 %", third_harmonic=0.15, model="suspect"),
    "scale": Group("truth: 1.4 times the load", stiffness=(1e7, 3e7), load_scale=1.4, model="suspect"),
    "jam": Group("packed coal: 4 mm less from a moment on", jam_m=4e-3, model="suspect"),
    "shift": Group("sensor shifted by 3 mm", shift_m=3e-3, sensor="suspect"),
    "stuck": Group("sensor stuck", stuck=True, sensor="suspect"),
    "scale_xy": Group("x and y 3 % too large", sensor_scale=(1.03, 1.03, 1.0), sensor="suspect"),
    "scale_theta": Group("theta 2 % too large", sensor_scale=(1.0, 1.0, 1.02), sensor="suspect"),
    "scale_all": Group("x, y and theta 5 % too large", sensor_scale=(1.05, 1.05, 1.05), sensor="suspect"),
    "stochastic_scale_xy": Group(
        "stochastic load, x and y 3 % too large",
        stochastic=True,
        load_step=2e-3,
        sensor_scale=(1.03, 1.03, 1.0),
        sensor="suspect",
    ),
    "mirrored_theta": Group("theta with the wrong sign", sensor_scale=(1.0, 1.0, -1.0), sensor="suspect"),
    "mirrored_x": Group("x with the wrong sign", sensor_scale=(-1.0, 1.0, 1.0), sensor="suspect"),
    "mirrored_y": Group("y with the wrong sign", sensor_scale=(1.0, -1.0, 1.0), sensor="suspect"),
    "swapped": Group("x and y swapped", swapped=True, sensor="suspect"),
    "hard_mirrored_theta": Group(
        "hard, theta with the wrong sign", stiffness=(1e9, 1e11), sensor_scale=(1.0, 1.0, -1.0), sensor="suspect"
    ),
    "hard_mirrored_y": Group(
        "hard, y with the wrong sign", stiffness=(1e9, 1e11), sensor_scale=(1.0, -1.0, 1.0), sensor="suspect"
    ),
    "hard_swapped": Group("hard, x and y swapped", stiffness=(1e9, 1e11), swapped=True, sensor="suspect"),
    "noisier": Group("sensor 4 times noisier from a moment on", noisier=4.0, sensor="suspect"),
}


@dataclass(frozen=True, eq=False)
class Truth:
    """A truth and the inputs of the estimate. `clearance` [m], shape (2,), is that at the end of the window."""

    group: Group
    scene: Scene
    nominal: Scene
    load: Load
    poses: Poses
    bias: Array
    delay: float
    gain: Array
    clearance: Array
    forces: ContactForces | None = None

    def write(self, folder: Path) -> None:
        """Write the folder that `plow-twin estimate` reads."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "scene.yaml").write_text(dump_scene(self.nominal), encoding="utf-8")
        tables = [
            ("load.csv", "t,fx,fy,m", np.column_stack([self.load.t, self.load.wrench])),
            ("pose.csv", "t,x,y,theta", np.column_stack([self.poses.t, self.poses.q])),
        ]
        if self.forces is not None:
            rows = np.column_stack([self.forces.t, self.forces.force])
            tables.append(("contact_forces.csv", ",".join(("t", *PAIR_NAMES)), rows))
        for name, header, table in tables:
            lines = [",".join("" if np.isnan(value) else repr(float(value)) for value in row) for row in table]
            (folder / name).write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")


def draw(group: Group, seed: int) -> Truth:
    """Draw a truth. A seed always gives the same truth."""
    rng = np.random.default_rng([20261121, seed])
    nominal = load_scene(ROOT / "config" / "paper.yaml")
    if group.machine is not None:
        nominal = group.machine(nominal)
    end = group.periods * PERIOD
    fine = np.arange(0.0, end + _FINE, _FINE)
    nominal_load = compile_loads(nominal.loads).at(fine)
    if group.stochastic:
        nominal_load = nominal_load + cutting(rng, fine) * np.array([8e3, 4e3, 1.1e4])
    gain = group.load_scale * (1.0 + group.load_error * rng.standard_normal(3))
    true_load = nominal_load * gain
    if group.third_harmonic:
        size = group.third_harmonic * np.abs(nominal_load).max(axis=0)
        true_load = true_load + size * np.sin(3.0 * 2.0 * np.pi / PERIOD * fine + 1.0)[:, None]
    scene = replace(
        nominal,
        clearance=Clearance(*rng.uniform(0.018, 0.034, 2)),
        contact=_contact(group, nominal.contact, rng),
        friction=Friction(group.friction) if group.friction else nominal.friction,
        loads=(Table("cutting", fine, true_load),),
        wear=Wear(group.wear_m2_n, 0.015, 2.0) if group.wear_m2_n else nominal.wear,
    )
    t = np.arange(0.0, end, 1.0 / group.rate_hz)
    delay = group.delay_s * rng.uniform()
    bias = group.bias_m * rng.standard_normal(3) * np.array([1.0, 1.0, 3.0])
    motion, clearance, force = _motion(scene, group, np.maximum(t - delay, 0.0), end)
    q = motion * group.sensor_scale + bias
    measured = _sensor(group, rng, t, q[:, [1, 0, 2]] if group.swapped else q)
    keep = _kept(group, rng, t, measured)
    knots = np.arange(0.0, end + group.load_step, group.load_step)
    wrench = np.stack([np.interp(knots, fine, column) for column in nominal_load.T], axis=1)
    poses, _ = Poses.of(t[keep], measured[keep])
    load, _ = Load.of(knots, wrench)
    forces = _cells(group, rng, force, end) if group.forces_hz else None
    return Truth(group, scene, nominal, load, poses, bias, delay, gain, clearance, forces)


def _contact(group: Group, nominal: Contact, rng: np.random.Generator) -> Contact:
    low, high = np.log(group.stiffness)
    stiffness = float(np.exp(rng.uniform(low, high)))
    if nominal.restitution is not None:
        return replace(nominal, stiffness=stiffness, restitution=rng.uniform(0.3, 0.8))
    share = float(np.exp(rng.normal(0.0, 0.4)))
    damping = (nominal.damping if nominal.ramp_m and nominal.damping else 0.72) * share
    if group.law == "kelvin_voigt":
        # above 3e7 N/m, the damping grows with the root of the stiffness, so that the damping ratio is independent of
        # the stiffness
        damping = 10.0 ** rng.uniform(4.5, 5.3) * max(1.0, np.sqrt(stiffness / 3e7))
    return replace(nominal, law=group.law, stiffness=stiffness, exponent=group.exponent, damping=damping)


def cutting(rng: np.random.Generator, t: Array) -> Array:
    """Return skewed broad-band noise of unit variance, shape (n, 3): white noise after a low-pass filter of 20 Hz."""
    decay = np.exp(-2.0 * np.pi * 20.0 * (t[1] - t[0]))
    drive = rng.gamma(4.0, 0.5, (len(t), 3)) - 2.0
    out = np.zeros((len(t), 3))
    for index in range(1, len(t)):
        out[index] = decay * out[index - 1] + np.sqrt(1.0 - decay**2) * drive[index]
    return out


def _motion(scene: Scene, group: Group, times: Array, end: float) -> tuple[Array, Array, Array]:
    """Return the poses at `times`, (n, 3), the clearances at the end, (2,), and the forces every `_FINE` s, (k, 8)."""
    if not group.jam_m:
        run = simulate(scene, end, _FINE, 1e-6)
        q = np.stack([np.interp(times, run.t, column) for column in run.q.T], axis=1)
        return q, clearances(scene, run.wear_depth)[:2], run.force
    first = simulate(scene, _FROM * end, _FINE, 1e-6)
    table = scene.loads[0]
    assert isinstance(table, Table)
    (qx, qy, theta), (vx, vy, omega) = first.q[-1].tolist(), first.v[-1].tolist()
    later = replace(
        scene,
        clearance=Clearance(scene.clearance.horizontal_m - group.jam_m, scene.clearance.vertical_m - group.jam_m),
        loads=(Table("later", table.t - _FROM * end + 1e-12, table.wrench),),
        initial=Initial((qx, qy, theta), (vx, vy, omega)),
    )
    second = simulate(later, end - _FROM * end, _FINE, 1e-6)
    t = np.concatenate([first.t, second.t[1:] + _FROM * end])
    q = np.concatenate([first.q, second.q[1:]])
    moved = np.stack([np.interp(times, t, column) for column in q.T], axis=1)
    return moved, clearances(scene, np.zeros(8))[:2], np.concatenate([first.force, second.force[1:]])


def _cells(group: Group, rng: np.random.Generator, force: Array, end: float) -> ContactForces:
    """Return the readings of load cells, given the true forces, shape (n, 8), at intervals of `_FINE`."""
    t = np.arange(0.0, end, 1.0 / group.forces_hz)
    late = np.maximum(t - group.forces_delay_s * rng.uniform(), 0.0)
    true = np.stack([np.interp(late, _FINE * np.arange(len(column)), column) for column in force.T], axis=1)
    gain = 1.0 + group.forces_gain * rng.standard_normal(8)
    return ContactForces.of(t, gain * true + group.forces_noise_n * rng.standard_normal(true.shape))[0]


def _sensor(group: Group, rng: np.random.Generator, t: Array, q: Array) -> Array:
    noise = group.noise_m * np.array([1.0, 1.0, 4.0]) * rng.standard_normal(q.shape)
    late = t > _FROM * t[-1]
    noise[late] *= group.noisier
    measured: Array = q + noise
    component = int(rng.integers(0, 2))
    measured[late, component] += group.shift_m
    if group.stuck:
        first = int(np.flatnonzero(late)[0])
        measured[first:, component] = measured[first, component]
    return measured


def _kept(group: Group, rng: np.random.Generator, t: Array, measured: Array) -> NDArray[np.bool_]:
    """Return a mask of the rows that arrive. Set single components of some rows to NaN in place."""
    keep = np.ones(len(t), dtype=bool)
    if group.gaps:
        for _ in range(4):
            start = rng.uniform(0.0, t[-1] - 2.0)
            keep &= ~((t > start) & (t < start + rng.uniform(0.3, 1.5)))
        keep &= rng.random(len(t)) > 0.05
        blank = rng.random(len(t)) < 0.3
        measured[blank, rng.integers(0, 3, blank.sum())] = np.nan
    return keep
