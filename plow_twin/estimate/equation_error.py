"""Estimate of walls and stiffness from the weak form of the equations of motion.

No motion is simulated, so errors of the load do not accumulate. The equations are multiplied by smooth test functions
psi. Integration by parts moves the derivatives from the measured poses q to psi:

    integral psi'' q  =  integral psi (load + contact) / M,
    contact = K sum n p (1 + d p'),   integral psi p p' = -1/2 integral psi' p^2,

where p are the penetrations at the four walls, n the normals, M the mass, K the stiffness and d the damping.
Gauss-Newton steps determine the positions of the walls, K and K d. If contacts last only a few samples, the result has
a bias, which the module `uncertain_load` corrects.

References: Shinbrot, Trans. ASME 79 (1957) 67 (modulating functions); Messenger and Bortz, J. Comput. Phys. 443 (2021)
110525 (weak form).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.measurements import Load, interpolated
from plow_twin.estimate.start import WALLS
from plow_twin.estimate.unknowns import Unknowns
from plow_twin.model import geometry
from plow_twin.model.pairs import NORMAL_X, NORMAL_Y
from plow_twin.solve.compiled_scene import inertias

Array = NDArray[np.float64]

#: Index of the wall of each pair, in the order right, left, top, bottom by definition.
_WALL: Final = np.argmax(np.stack(WALLS), axis=0)
#: Gauss-Newton iteration: upper bound on the number of steps, size in m of a step that ends it, largest step in m.
_STEPS, _SMALL, _LONGEST = 8, 2e-5, 3e-3
#: Lower bounds on the interval between rows in s, and on the number of rows in half of a test function.
_SHORTEST, _FEWEST = 5e-3, 3
#: Unit of the stiffness in N/m, derived so that all columns of the linear system have about the same size.
_UNIT = 1e7
#: Deviate beyond which Huber's function is linear, and standard deviation divided by median absolute deviation, derived
#: for a normal distribution.
_HUBER, _MAD = 2.0, 1.4826
#: Starting values of a search within the bounds of the unknowns: clearances as shares of the range of motion, and
#: penetrations in m.
_SHARES, _DEPTHS = (0.25, 0.5, 0.75, 0.95), (3e-3, 6e-3, 12e-3, 20e-3)
#: Lower and upper bound on the penetration in m under the reference force.
DEPTHS: Final = (2e-4, 3e-2)
#: Smallest size of a column of the linear system, a guard against division by zero.
_SINGULAR = 1e-9


@dataclass(frozen=True, eq=False)
class Walls:
    """Result of a fit of the weak form.

    reach : (4,) distance in m that the corners can move to the right, left, top and bottom before they touch the wall
    ln_depth : logarithm of the penetration in m under the reference force
    damping : damping factor of the Hunt-Crossley law in s/m
    left_over : (3,) logarithm of the residual acceleration's scatter divided by the acceleration's scatter
    loss : sum of the logarithms of the scatters of the residual acceleration
    """

    reach: Array
    ln_depth: float
    damping: float
    left_over: Array
    loss: float

    @property
    def clearance(self) -> Array:
        """Clearances in m, shape (2,)."""
        return self.reach[::2] + self.reach[1::2]

    @property
    def features(self) -> Array:
        """Features for a regression, shape (7,), of which the first two are the clearances."""
        return np.concatenate([self.clearance, [self.ln_depth, np.clip(self.damping, -2.0, 3.0)], self.left_over])


class EquationError:
    """The weak form of the equations of motion of a scene under the measured load, for poses at given times.

    Parameters
    ----------
    unknowns : Unknowns
        The scene, and the reference force at which penetrations are stated.
    load : Load
        The measured load.
    t : ndarray, shape (n,)
        Times of the poses in s.
    """

    def __init__(self, unknowns: Unknowns, load: Load, t: Array) -> None:
        scene = unknowns.scene
        step = max(float(np.median(np.diff(t))), _SHORTEST)
        self._t, self._grid = t, np.arange(t[0], t[-1], step)
        half = max(_FEWEST, round(0.5 * tuning.MODULATED / step))
        s, span = np.arange(1 - half, half) / half, half * step
        bump = 1.0 - s * s
        # the test function (1 - s^2)^3 and its first two time derivatives, times the integration step
        self._value = step * bump**3
        self._slope = -6.0 * step / span * s * bump**2
        self._curve = step / span**2 * (24.0 * s * s * bump - 6.0 * bump**2)
        self._apart = max(1, half // 2)
        self._force, self._scene = unknowns.force, scene
        self._rows, self._arms = geometry.penetration_rows(scene)[:4], geometry.arm_rows(scene)
        self._inertia = np.asarray(inertias(scene))
        self._half_size = np.where(NORMAL_X != 0.0, scene.frame.width_m, scene.frame.height_m) / 2.0
        wrench = load.at(self._grid)
        self._load = self._weighed(wrench, self._value) / self._inertia

    def search(self, q: Array, span: Array) -> Walls:
        """Return the fit with the smallest loss from several starting points.

        `q` contains the poses, shape (n, 3), and `span` the range of motion in m, shape (2,).
        """
        fits = [
            self.fit(q, np.repeat(0.5 * share * span, 2), math.log(depth)) for depth in _DEPTHS for share in _SHARES
        ]
        return min(fits, key=lambda fit: fit.loss)

    def fit(self, q: Array, reach: Array, ln_depth: float) -> Walls:
        """Return the fit to the poses `q`, (n, 3), from starting values of the reaches (4,) [m] and of `ln_depth`."""
        poses = interpolated(self._grid, self._t, q)
        corners, normals = self._geometry(poses)
        acceleration = self._weighed(poses, self._curve)
        stiffness, weight = self._force / math.exp(ln_depth), np.ones_like(acceleration)
        for _ in range(_STEPS):
            columns = self._columns(corners, normals, reach, stiffness)
            fits, residual = self._solve(columns, acceleration - self._load, weight)
            scale = _MAD * np.median(np.abs(residual), axis=0) + _SINGULAR
            weight = np.minimum(1.0, np.sqrt(_HUBER * scale / np.maximum(np.abs(residual), _SINGULAR))) / scale
            ln_depth = float(np.clip(math.log(self._force / max(_UNIT * fits[0], 1.0)), *np.log(DEPTHS)))
            stiffness = self._force / math.exp(ln_depth)
            step = np.clip(fits[2:6], -_LONGEST, _LONGEST)
            reach = reach + step
            if np.abs(step).max() < _SMALL:
                break
        all_of_it = np.median(np.abs(acceleration), axis=0) + _SINGULAR
        damping = float(_UNIT * fits[1] / stiffness)
        return Walls(reach, ln_depth, damping, np.log(scale / all_of_it), float(np.log(scale).sum()))

    def touched(self, q: Array, walls: Walls, deeper: float) -> Array:
        """Return the time in s during which a corner is more than `deeper` m behind each wall, shape (4,)."""
        poses = interpolated(self._grid, self._t, q)
        beyond = self._geometry(poses)[0] - walls.reach[_WALL] > deeper
        step = self._grid[1] - self._grid[0]
        return np.array([step * beyond[:, wall].any(axis=1).sum() for wall in WALLS])

    def required_load(self, q: Array, reach: Array, ln_depth: float, damping: float) -> Load:
        """Return the load that moves the head along poses (n, 3) between walls with these properties.

        It is averaged over `tuning.LOAD_AVERAGED`, because its values during impacts are wrong.
        """
        poses = interpolated(self._grid, self._t, q)
        stiffness = self._force / math.exp(ln_depth)
        columns = self._columns(*self._geometry(poses), reach, stiffness)[..., :2]
        contact = columns @ np.array([stiffness, stiffness * damping]) / _UNIT
        required = (self._weighed(poses, self._curve) - contact) / self._value.sum()
        step = float(self._grid[1] - self._grid[0])
        count = max(1, round(tuning.LOAD_AVERAGED / (self._apart * step)))
        mean = np.stack([np.convolve(column, np.full(count, 1.0 / count), "valid") for column in required.T], axis=1)
        first = len(self._value) // 2 + 0.5 * (count - 1) * self._apart
        t = self._grid[0] + step * (first + self._apart * np.arange(len(mean)))
        mass, gravity = self._scene.head.mass_kg, self._scene.gravity
        weight = mass * gravity.acceleration_m_s2 * np.array([0.0, -1.0, -gravity.arm_m])
        return Load(t, mean * self._inertia - weight)

    def _geometry(self, q: Array) -> tuple[Array, Array]:
        """Return the reach of each pair in m, (n, 8), and the acceleration per force of each pair, (n, 3, 8)."""
        c, s = np.cos(q[:, 2]), np.sin(q[:, 2])
        body = np.stack([c, s, c * q[:, 0] + s * q[:, 1], -s * q[:, 0] + c * q[:, 1]], axis=1)
        x = c[:, None] * NORMAL_X - s[:, None] * NORMAL_Y
        y = s[:, None] * NORMAL_X + c[:, None] * NORMAL_Y
        directions = np.stack([x, y, body @ self._arms], axis=1) / self._inertia[:, None]
        return body @ self._rows - self._half_size, directions

    def _columns(self, corners: Array, normals: Array, reach: Array, stiffness: float) -> Array:
        """Return the derivatives with respect to stiffness, damping, four walls and three constant loads, (m, 3, 9)."""
        beyond = np.maximum(corners - reach[_WALL], 0.0)
        touching = (beyond > 0.0).astype(np.float64)
        spring = self._weighed(np.einsum("nik,nk->ni", normals, beyond), self._value)
        damper = -0.5 * self._weighed(np.einsum("nik,nk->ni", normals, beyond**2), self._slope)
        by_wall = [np.einsum("nik,nk->ni", normals[:, :, wall], touching[:, wall]) for wall in WALLS]
        walls = -stiffness * self._weighed(np.stack(by_wall, axis=2), self._value)
        constant = np.broadcast_to(self._value.sum() * np.eye(3), (len(spring), 3, 3))
        return np.concatenate([_UNIT * spring[:, :, None], _UNIT * damper[:, :, None], walls, constant], axis=2)

    @staticmethod
    def _solve(columns: Array, target: Array, weight: Array) -> tuple[Array, Array]:
        """Return the weighted least-squares solution (9,) and its residuals, shape (m, 3)."""
        rows = (columns * weight[:, :, None]).reshape(-1, columns.shape[2])
        normal = rows.T @ rows
        held = np.zeros(len(normal))
        held[2:6] = _LONGEST**-2.0
        normal += np.diag(held + _SINGULAR * np.diag(normal) + _SINGULAR)
        solution = np.asarray(np.linalg.solve(normal, rows.T @ (target * weight).ravel()), np.float64)
        return solution, target - columns @ solution

    def _weighed(self, values: Array, kernel: Array) -> Array:
        """Return the integrals, (m, ...), of `values`, (n, ...), times the test function or derivative `kernel`."""
        windows = np.lib.stride_tricks.sliding_window_view(values, len(kernel), axis=0)[:: self._apart]
        out: Array = windows @ kernel
        return out
