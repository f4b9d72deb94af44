"""The interface of a method (`solve.method.protocol`), checked on states that each method accepts and rejects."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import preset, wall_and_point
from test_solve_flight import swaying

from plow_twin import Contact, Initial, Scene
from plow_twin.kernel.compiler import kernel
from plow_twin.solve.compiled_scene import CompiledScene, compile_scene
from plow_twin.solve.method import flight, implicit, rest, taylor
from plow_twin.solve.method.protocol import Method
from plow_twin.solve.modes import weigh_pairs
from plow_twin.solve.state import new_work
from plow_twin.solve.step import METHODS

#: Fields of the state that every method may write.
OUTPUT = {"alpha", "beta", "sigma_end", "order", "ends_at_stop", "evaluations"}
DECAY = {"implicit_size", "decay_times", "refused"}
#: Additional fields of the state that a single method may write.
OWN = {
    flight: {"in_flight"},
    rest: {"at_rest", "y"},
    implicit: {*DECAY, *(f"{name}_before" for name in DECAY), "implicit_steps"},
    taylor: set(),
}
SPAN, TOLERANCE = 0.5, 1e-6


@kernel(inline="source")
def _weighed(p, parts, state, w):
    """Prepare a step as `lay_out_step` does. Return whether any pair is inside its wall."""
    terms = parts.terms
    state.alpha, state.beta = 1.0, 0.0
    return weigh_pairs(p, state, w, terms.viscous, terms.fraction, terms.ramp, terms.stick)


@kernel(entry=True)
def _ask_flight(p, parts, state, w, span) -> bool:
    return flight.lay_out(p, parts, flight.own(parts), state, w, span, _weighed(p, parts, state, w))


@kernel(entry=True)
def _ask_rest(p, parts, state, w, span) -> bool:
    return rest.lay_out(p, parts, rest.own(parts), state, w, span, _weighed(p, parts, state, w))


@kernel(entry=True)
def _ask_implicit(p, parts, state, w, span) -> bool:
    return implicit.lay_out(p, parts, implicit.own(parts), state, w, span, _weighed(p, parts, state, w))


@kernel(entry=True)
def _ask_taylor(p, parts, state, w, span) -> bool:
    return taylor.lay_out(p, parts, taylor.own(parts), state, w, span, _weighed(p, parts, state, w))


ASK: dict[Any, Callable[..., bool]] = {
    flight: _ask_flight, rest: _ask_rest, implicit: _ask_implicit, taylor: _ask_taylor
}  # fmt: skip


def pressed(damping: float, share: float) -> Scene:
    """Return a head that gravity presses on two corners, at a share of the equilibrium depth, with its slow velocity.

    After the time constant of the mass, C d' + K d = m g / 2 at each corner.
    """
    stiffness, mass, g = 1e7, 2.0, 9.81
    contact = Contact("kelvin_voigt", stiffness, damping=damping)
    scene = wall_and_point(contact, speed=0.0, mass=mass, gravity=g, gap=0.0, pairs=("top_left_top", "top_right_top"))
    depth, rate = share * 0.5 * mass * g / stiffness, (1.0 - share) * 0.5 * mass * g / damping
    return replace(scene, initial=Initial((0.0, -depth, 0.0), (0.0, -rate, 0.0)))


SCENES: dict[str, Callable[[], Scene]] = {
    "free": swaying,
    "at rest": lambda: pressed(1e4, 1.0),
    "overdamped": lambda: pressed(1e9, 0.5),
    "moving": lambda: preset("paper"),
}


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.__name__.rpartition(".")[2])
def test_a_method_has_the_signatures_of_the_contract(method: Any) -> None:
    for name in ("own", "lay_out"):
        signature = inspect.signature(getattr(method, name).py_func)
        expected = inspect.signature(getattr(Method, name))
        assert list(signature.parameters) == list(expected.parameters)[1:]


@pytest.mark.parametrize("name", SCENES)
def test_a_method_lays_out_a_step_or_leaves_the_state_to_the_next_method(name: str) -> None:
    compiled: CompiledScene = compile_scene(SCENES[name](), TOLERANCE)
    takes = set()
    for method in METHODS:
        state, w = compiled.initial_state(), new_work()
        # the overdamped contact has lasted so long that its fast part has decayed
        state.decay_times = 1e3
        w.wrench[0] = compiled.params.constant
        before = state.copy()
        prepared = ASK[method](compiled.params, compiled.parts, state, w, SPAN)
        changed = {field for field in state.dtype.names if not np.array_equal(state[field], before[field])}
        assert changed <= OUTPUT | OWN[method]
        if "y" in changed:
            assert prepared and np.abs(state.y - before.y).max() < 1e-3 * compiled.params.position_tolerance
        if prepared:
            takes.add(method)
            assert state.sigma_end > 0.0 and 1 <= state.order <= compiled.params.order
            reached = state.alpha * state.sigma_end + 0.5 * state.beta * state.sigma_end**2
            assert reached <= SPAN * (1.0 + 1e-12) and (state.ends_at_stop == 1) == (reached == pytest.approx(SPAN))
    assert takes == {
        "free": {flight, taylor}, "at rest": {rest, taylor}, "overdamped": {implicit, taylor}, "moving": {taylor}
    }[name]  # fmt: skip
