"""Derivatives of a live twin's motion with respect to its initial state and to parameters.

The derivatives are computed from shadows, which are copies of the twin with a small displacement or a changed
parameter. Shadows start anew at each stretch of some 0.1 s.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.errors import ArgumentError, SolverError
from plow_twin.run.advance import Advance
from plow_twin.run.batch import TwinBatch
from plow_twin.run.sensitivity import (
    DISPLACEMENT,
    LONGEST_S,
    SHADOW_TOLERANCE,
    ChangedScene,
    StretchProduct,
    free_places,
    possible_displacement,
    refuse_support,
    scale_of,
    sensitivity_parameters,
)
from plow_twin.run.twin import Twin
from plow_twin.solve.compiled_scene import compile_scene
from plow_twin.solve.state import Status

Array = NDArray[np.float64]

#: `_STRETCH_S`: length of a stretch in s. `_FAR`: growth factor of a shadow's displacement at which a stretch ends.
_STRETCH_S, _FAR = 0.1, 100.0


class TwinSensitivity:
    """Derivatives of a twin's state with respect to its initial state and to parameters, updated with each advance.

    Parameters
    ----------
    twin : Twin
        A twin with `excitation="sampled"`. After the creation of this object, only its method `advance` may advance the
        twin. The results of this method are bit-identical to `Twin.advance`.
    parameters : sequence of str
        Paths of the parameters with respect to which derivatives are computed, from `sensitivity_parameters`.

    Attributes
    ----------
    t : float
        Model time in s at the end of the last complete stretch, to which the attributes below refer. This time is some
        0.1 s before the time of the twin, and up to 0.5 s during a contact.
    from_start : ndarray, shape (k, k)
        Derivatives of the state at `t` with respect to the twin's state when this object was created. A state contains
        the coordinates of the k / 2 free degrees of freedom, followed by their rates.
    by_parameter : dict of str to ndarray, shape (k,)
        Derivatives of the state at `t` with respect to the parameters, for a fixed initial state.
    growth : float
        Largest factor by which an error at any earlier time has grown until `t`, as in `Sensitivity.growth`.
    exponent : float
        Largest Lyapunov exponent in 1/s since this object was created.

    Raises
    ------
    ArgumentError
        The scene does not have one of the parameters or has a `Support`, or the twin is not sampled.
    """

    def __init__(self, twin: Twin, parameters: Sequence[str] = ()) -> None:
        if twin.excitation != "sampled":
            raise ArgumentError("twin: got excitation='scene', expected excitation='sampled'")
        refuse_support(twin.scene)
        scene, available = twin.scene, sensitivity_parameters(twin.scene)
        for path in parameters:
            if path not in available or path.startswith("loads."):
                allowed = ", ".join(name for name in available if not name.startswith("loads."))
                raise ArgumentError(f"parameters: got {path!r}, expected one of {allowed}")
        self._twin = twin
        self._changed = [ChangedScene.of(scene, path, SHADOW_TOLERANCE) for path in parameters]
        compiled = compile_scene(scene, SHADOW_TOLERANCE, sampled=True)
        self._scale, self._free, self._enabled = scale_of(compiled), free_places(scene), compiled.params.enabled == 1
        self._reads_speed = bool(compiled.params.damping_number >= 0.0)
        size = len(self._free)
        members = [scene] * (1 + size) + [change.compiled.scene for change in self._changed]
        self._shadows = TwinBatch(members, tol=SHADOW_TOLERANCE, start=twin.time)
        self.t = self._begin = twin.time
        self._product, self._logs = StretchProduct(size, len(parameters)), np.zeros(size)
        self._start(again=False)

    @property
    def from_start(self) -> Array:
        """Derivatives of the state at `t` with respect to the state when this object was created."""
        scale = self._scale[self._free]
        return np.asarray(self._product.total * scale[:, None] / scale[None, :])

    @property
    def by_parameter(self) -> dict[str, Array]:
        """Derivatives of the state at `t` with respect to the parameters."""
        return {
            change.path: row * self._scale[self._free]
            for change, row in zip(self._changed, self._product.rows, strict=True)
        }

    @property
    def growth(self) -> float:
        """Largest factor by which an error at any earlier time has grown until `t`."""
        return self._product.growth

    @property
    def exponent(self) -> float:
        """Largest Lyapunov exponent in 1/s."""
        return float(self._logs.max()) / max(self.t - self._begin, 1e-300)

    def advance(self, t: float, wrench: ArrayLike | None = None) -> Advance:
        """Advance the twin and its shadows.

        Parameters
        ----------
        t : float
            Model time in s.
        wrench : array_like, shape (3,), optional
            Wrench of the load at `t`, as in `Twin.advance`.

        Returns
        -------
        Advance
            Result of `Twin.advance`.

        Raises
        ------
        SolverError
            The solver cannot continue the motion of a shadow.
        """
        advanced = self._twin.advance(t, wrench)
        rows = self._shadows.advance(t, self._twin.wrench)
        if (rows.status != Status.OK).any():
            raise SolverError(f"shadow at t = {t:.9g} s: {Status(int(rows.status.max())).text}")
        reached = np.concatenate([rows.q[:, 0], rows.v[:, 0]], axis=1)
        away = (reached[1:] - reached[0])[:, self._free] / self._scale[self._free]
        size = len(self._free)
        if t - self.t >= _STRETCH_S or np.abs(away[:size]).max() > _FAR * DISPLACEMENT:
            depths = rows.penetration[0, 0, self._enabled]
            clear = possible_displacement(depths, float(self._scale[0]), reads_speed=self._reads_speed) is not None
            if clear or t - self.t >= LONGEST_S:
                self._end(t, away[:size].T / DISPLACEMENT, away[size:])
        return advanced

    def _end(self, t: float, matrix: Array, changes: Array) -> None:
        """End a stretch with its fundamental matrix `matrix` and the scaled effects `changes` of the parameters."""
        by_unit = changes / np.array([change.change for change in self._changed])[:, None]
        self._logs += self._product.follow(matrix[None], by_unit[None], np.ones(1, bool))[3][0]
        self.t = t
        self._start()

    def _start(self, again: bool = True) -> None:
        """Start a stretch: set all shadows to the twin's state or to a displaced state."""
        size = len(self._free)
        moved = np.zeros((len(self._shadows), 6))
        moved[np.arange(1, 1 + size), self._free] = DISPLACEMENT * self._scale[self._free]
        self._shadows.begin_displaced(self._twin.snapshot(), moved, again=again)
