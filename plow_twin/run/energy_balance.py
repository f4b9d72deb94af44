"""Balance of energy and momentum of a run, from the sums that the solver has accumulated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.solve.compiled_scene import CompiledScene
from plow_twin.solve.energy_balance import FRICTION, LOAD_X, LOADS, NORMAL, SUPPORT, BalanceSums
from plow_twin.solve.state import COS, SIN, THETA, State, X, Y

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EnergyBalance:
    """Balance of energy and momentum of a run, which compares integrals of the forces with changes of the state.

    Attributes
    ----------
    kinetic_j : tuple of float
        Kinetic energy in J at the start and at the end. The energy of a frame on springs is included.
    stored_j : tuple of float
        Elastic energy K d^(n+1) / (n+1) of the contacts in J, at the start and at the end.
    load_work_j : float
        Work in J of the loads without gravity.
    gravity_work_j : float
        Work in J of gravity and of its constant moment.
    contact_work_j : float
        Energy in J that normal contact forces take from the head.
    friction_work_j : float
        Energy in J that friction takes from the head.
    support_work_j : float
        Energy in J that the springs and dampers of a `Support` take.
    dissipated_j : float
        Part of `contact_work_j` that the contacts do not store at the end, in J.
    turnover_j : float
        Integral of the absolute values of all powers in J.
    imbalance_j : float
        Largest |change of kinetic energy - work| at the end of any step, in J.
    momentum : ndarray, shape (3,)
        Change of m vx, m vy [N s] and I omega [N m s] in world axes. vx and vy belong to the centre of mass.
    impulse : ndarray, shape (2, 3)
        Time integrals of the loads including gravity, and of the contact forces. Locked axes are excluded.
    momentum_imbalance : ndarray, shape (3,)
        Largest |change of momentum - impulse| at the end of any step.
    """

    kinetic_j: tuple[float, float]
    stored_j: tuple[float, float]
    load_work_j: float
    gravity_work_j: float
    contact_work_j: float
    friction_work_j: float
    support_work_j: float
    dissipated_j: float
    turnover_j: float
    imbalance_j: float
    momentum: Array
    impulse: Array
    momentum_imbalance: Array

    @property
    def relative_imbalance(self) -> float:
        """Energy imbalance divided by the turnover."""
        return self.imbalance_j / self.turnover_j if self.turnover_j > 0.0 else 0.0


def energy_balance_of(compiled: CompiledScene, last: State, summed: BalanceSums) -> EnergyBalance:
    """Return the balance of a motion from its initial state to the state `last`."""
    sums, scene, first = summed.sums, compiled.scene, compiled.initial_state()
    gravity = _potential(scene, first) - _potential(scene, last)
    stored = _stored(compiled, first), _stored(compiled, last)
    contact = float(sums.work[NORMAL])
    return EnergyBalance(
        kinetic_j=(float(sums.energy[0]), float(sums.energy[1])),
        stored_j=stored,
        load_work_j=float(sums.work[LOADS]) - gravity,
        gravity_work_j=gravity,
        contact_work_j=contact,
        friction_work_j=float(sums.work[FRICTION]),
        support_work_j=float(sums.work[SUPPORT]),
        dissipated_j=contact - (stored[1] - stored[0]),
        turnover_j=float(sums.turnover),
        imbalance_j=float(sums.residual),
        momentum=sums.momentum[1] - sums.momentum[0],
        impulse=sums.work[LOAD_X:].reshape(2, 3).copy(),
        momentum_imbalance=sums.momentum_residual.copy(),
    )


def _potential(scene: Scene, state: State) -> float:
    """Return the potential energy of gravity and of its constant moment in J."""
    x, y, theta, lift = state.y[X], state.y[Y], state.y[THETA], 0.0
    if scene.support is not None:
        theta, lift = theta + state.frame[2], state.frame[1]
    height = y if scene.head.carries == "corners" else math.sin(theta) * x + math.cos(theta) * y + lift
    return float(scene.head.mass_kg * scene.gravity.acceleration_m_s2 * (height + scene.gravity.arm_m * theta))


def _stored(compiled: CompiledScene, state: State) -> float:
    rows = compiled.params.penetration_rows
    penetration = rows.T @ np.array([state.y[COS], state.y[SIN], state.y[X], state.y[Y], 1.0]) - state.wear_depth
    return float(elastic_energy(compiled.scene, penetration))


def elastic_energy(scene: Scene, penetration: Array) -> Array:
    """Return the total elastic energy of the contacts in J, shape (...), for penetrations in m, shape (..., 8)."""
    contact = scene.contact
    inside = np.where(np.isin(PAIR_NAMES, scene.pairs), np.maximum(penetration, 0.0), 0.0)
    energy = contact.stiffness * (inside ** (contact.exponent + 1.0)).sum(axis=-1) / (contact.exponent + 1.0)
    return np.asarray(energy)
