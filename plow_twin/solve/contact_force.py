"""Contact force of a pair by `model.contact`, with the constants and the state of a scene."""

from __future__ import annotations

from plow_twin.kernel.compiler import kernel
from plow_twin.model.contact import free_force, normal_force


@kernel(inline="source")
def law_terms(terms):
    """Return the terms of the contact law as a plain tuple, which kernels can unpack."""
    return terms.viscous, terms.hysteretic, terms.integer, terms.fraction, terms.ramp


@kernel(inline="code")
def law_force(p, state, pair, penetration, rate):
    """Return the force of a pair in N by its contact law, negative where the pair would pull."""
    return free_force(penetration, rate, p.stiffness, p.exponent, state.damping_factor[pair], p.viscous, p.ramp)


@kernel(inline="code")
def pair_force(p, state, pair, penetration, rate):
    """Return the force of a pair in N, which is zero without penetration and where the law would pull."""
    return normal_force(penetration, rate, p.stiffness, p.exponent, state.damping_factor[pair], p.viscous, p.ramp)
