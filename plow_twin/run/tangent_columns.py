"""Columns of the linearised equations (`solve.tangents`): displacements and changes of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.solve.compiled_scene import CompiledScene, options, per_mass
from plow_twin.solve.state import Terms, new_records
from plow_twin.solve.tangents import COLUMNS, STATE_COLUMNS, WIDTH

_Array = NDArray[np.float64]

#: Terms that the linearised equations support.
_COVERED: Final = {"harmonics", "second", "viscous", "hysteretic", "integer", "fraction", "flight", "rest"}


def fits_tangents(compiled: CompiledScene) -> bool:
    """Return whether the linearised equations support all terms of a scene. Exponents must be integers or 1.5.

    A law with a constant restitution is supported, although slow touches under it need implicit steps.
    """
    terms, contact = compiled.parts.terms, compiled.scene.contact
    present = {name for name, term in zip(Terms._fields, terms, strict=True) if term is not None}
    supported = terms.fraction is None or contact.exponent == 1.5
    explicit = compiled.parts.implicit is None or contact.restitution is not None
    alike = not (options(compiled.scene).corners or options(compiled.scene).falling)
    return supported and explicit and present <= _COVERED and alike


def is_curved(terms: Terms) -> int | None:
    """Return 1 if the contact force is nonlinear in penetration and rate, and None otherwise."""
    return 1 if terms.hysteretic or terms.integer or terms.fraction else None


def displaced_columns(
    compiled: CompiledScene, changed: Sequence[tuple[CompiledScene, float]]
) -> tuple[NDArray[np.void], _Array, _Array]:
    """Compute the columns for displacements of the state, and for changes of one parameter each.

    Returns
    -------
    columns : ndarray of `COLUMNS`, shape (b,)
    omegas : ndarray, shape (h,)
        Angular frequencies of the loads in rad/s.
    amplitudes : ndarray, shape (b, h, 2, 3, 8)
        Changes of the loads' sine and cosine amplitudes per unit of each column's parameter, divided by mass or
        inertia.
    """
    blocks = -(-(STATE_COLUMNS + len(changed)) // WIDTH)
    columns, omegas = new_records(COLUMNS, blocks), compiled.loads.omega
    amplitudes, start = np.zeros((blocks, len(omegas), 2, 3, WIDTH)), compiled.initial_state()
    for index, (other, change) in enumerate(changed, STATE_COLUMNS):
        block, lane = divmod(index, WIDTH)
        column, displaced_params, own_params = columns[block], other.params, compiled.params
        for name, of in (("stiffness", "stiffness"), ("viscous", "viscous"), ("number", "damping_number")):
            column[name][lane] = (displaced_params[of] - own_params[of]) / change
        column["edge"][:, lane] = (displaced_params.penetration_rows[4] - own_params.penetration_rows[4]) / change
        column["constant"][:, lane] = (displaced_params.constant - own_params.constant) / change
        column["factor"][:, lane] = (other.initial_state().damping_factor - start.damping_factor) / change
        waves = np.stack([other.loads.sine - compiled.loads.sine, other.loads.cosine - compiled.loads.cosine], axis=1)
        amplitudes[block, ..., lane] = per_mass(compiled.scene, waves) / change
        if column["constant"][:, lane].any() or waves.any():
            columns["loaded"][block] = 1
    return columns, omegas, amplitudes
