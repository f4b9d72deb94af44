"""Growth of errors: comparison with finite differences and with the exponent of a map; derivatives of motions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scenes import preset
from test_known_ball import GRAVITY, OMEGA, PERIOD

from plow_twin import (
    ArgumentError,
    Clearance,
    Contact,
    Frame,
    Gravity,
    Harmonic,
    Head,
    Initial,
    Scene,
    ToleranceWarning,
    Twin,
    TwinSensitivity,
    sensitivity_parameters,
    simulate,
)
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import MOST_DAMPING_FACTOR
from plow_twin.run import sensitivity
from plow_twin.solve.compiled_scene import compile_scene
from plow_twin.study.parameters import with_parameters


def bouncing(gamma: float, r: float, stiffness: float) -> Scene:
    """Return a ball on a table that vibrates with A w^2 = gamma g, in the table's frame, on its period-one orbit."""
    phase = math.acos(math.pi * (1.0 - r) / (1.0 + r) / gamma)
    speed = 0.5 * GRAVITY * PERIOD - gamma * GRAVITY / OMEGA * math.cos(phase)
    return Scene(
        head=Head(1.0, 1.0),
        frame=Frame(0.2, 0.2),
        clearance=Clearance(0.5, 0.5),
        contact=Contact("exact_restitution", stiffness, restitution=r),
        gravity=Gravity(GRAVITY),
        loads=(Harmonic("table", (0.0, gamma * GRAVITY), OMEGA, phase),),
        initial=Initial((0.0, -0.25, 0.0), (0.0, speed, 0.0)),
        locked=("x", "theta"),
        pairs=("top_left_top",),
    )


def test_the_exponent_of_a_ball_on_a_vibrating_table_agrees_with_its_map() -> None:
    """The map of the impacts shrinks areas by r^2 per period. Its two eigenvalues of size r give ln(r) per period."""
    r = 0.5
    result = simulate(bouncing(1.3, r, 1e10), 4.0, sensitivity=True)
    assert result.sensitivity is not None and result.sensitivity.trusted
    assert result.sensitivity.exponent == pytest.approx(math.log(r) / PERIOD, rel=0.05)


def test_the_derivatives_are_finite_differences_of_the_motion() -> None:
    scene = replace(preset("bench_kv"), initial=Initial((0.001, 0.002, 0.003), (0.1, 0.0, 0.2)))
    result = simulate(scene, 0.5, sensitivity=True).sensitivity
    assert result is not None
    for column, (name, size) in enumerate(
        [("q", 1e-6), ("q", 1e-6), ("q", 1e-6), ("v", 1e-6), ("v", 1e-6), ("v", 1e-6)]
    ):
        ends = []
        for sign in (1.0, -1.0):
            moved = np.array(getattr(scene.initial, name))
            moved[column % 3] += sign * size
            other = replace(scene, initial=replace(scene.initial, **{name: tuple(moved)}))
            run = simulate(other, 0.5, tol=1e-12)
            ends.append(np.concatenate([run.q[-1], run.v[-1]]))
        expected = (ends[0] - ends[1]) / (2.0 * size)
        assert result.from_start[-1][:, column] == pytest.approx(expected, abs=1e-3 * abs(result.from_start[-1]).max())


@pytest.mark.parametrize("name", ["bench_kv", pytest.param("paper", marks=pytest.mark.stress)])
def test_the_derivatives_by_parameters_are_finite_differences_of_the_motion(name: str) -> None:
    """The parameters are stiffness, damping, clearances and load gains. The motion has several touches."""
    scene = replace(preset(name), initial=Initial((0.001, 0.002, 0.003), (0.1, 0.0, 0.2)))
    paths = sensitivity_parameters(scene)
    assert {"contact.stiffness", "contact.damping", "clearance.vertical_m"} < set(paths) and len(paths) >= 5
    result = simulate(scene, 0.5, sensitivity=tuple(paths))
    assert len(result.events) > 3 and result.sensitivity is not None
    for path, value in paths.items():
        ends = []
        for sign in (1.0, -1.0):
            run = simulate(with_parameters(scene, {path: value * (1.0 + sign * 1e-5)}), 0.5, tol=1e-12)
            ends.append(np.concatenate([run.q[-1], run.v[-1]]))
        expected = (ends[0] - ends[1]) / (2e-5 * value)
        sensitivity = result.sensitivity.by_parameter[path][-1]
        assert sensitivity == pytest.approx(expected, abs=1e-3 * np.abs(expected).max()), path
    with pytest.raises(ArgumentError, match=r"got 'contact\.exponent', expected one of contact\.stiffness"):
        simulate(scene, 0.5, sensitivity=("contact.exponent",))


def _law(name: str) -> Scene:
    """Return the paper's scene, thrown, with a law whose force is nonlinear or depends on the speed of a touch."""
    scene = replace(preset("paper"), initial=Initial((0.001, 0.002, 0.003), (0.4, 0.1, 0.8)))
    stiffness = scene.contact.stiffness
    contact = {
        # with this floor, which the presets have too, no implicit step is possible, and the kernels of the presets are
        # used
        "restitution": Contact("exact_restitution", stiffness, restitution=0.7, impact_speed_floor_m_s=0.05),
        "Hertz with restitution": Contact(
            "exact_restitution", 30.0 * stiffness, 1.5, restitution=0.7, impact_speed_floor_m_s=0.05
        ),
        "square": Contact("hunt_crossley", 300.0 * stiffness, 2.0, damping=0.5),
        "cube": Contact("hunt_crossley", 3e4 * stiffness, 3.0, damping=0.5),
    }[name]
    return replace(scene, contact=contact)


# each exponent needs additional compiled kernels
@pytest.mark.parametrize(
    "name",
    [
        "Hertz with restitution",
        *(pytest.param(name, marks=pytest.mark.stress) for name in ("restitution", "square", "cube")),
    ],
)
def test_the_linearised_equations_agree_with_displaced_motions(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests above, which compare differences of runs, do not cover these laws.

    The derivatives are those of the linearised equations, not of displaced runs.
    """
    scene, used = _law(name), list[int]()
    paths = tuple(sensitivity_parameters(scene))
    beside = sensitivity.displaced_columns
    monkeypatch.setattr(sensitivity, "displaced_columns", lambda *given: used.append(1) or beside(*given))
    derivatives = sensitivity.sensitivity_of(scene, 0.5, 1e-9, paths)
    assert used
    monkeypatch.setattr(sensitivity, "fits_tangents", lambda compiled: False)
    shadows = sensitivity.sensitivity_of(scene, 0.5, 1e-9, paths)
    assert derivatives.growth.max() == pytest.approx(shadows.growth.max(), rel=1e-4)
    assert derivatives.exponent == pytest.approx(shadows.exponent, rel=1e-4)
    for place in (50, 100, 150, 200):
        pairs = [(derivatives.from_start[place], shadows.from_start[place])]
        pairs += [(derivatives.by_parameter[path][place], shadows.by_parameter[path][place]) for path in paths]
        for equations, differences in pairs:
            assert equations == pytest.approx(differences, abs=1e-4 * np.abs(differences).max())


def test_a_contact_of_many_stretches_keeps_the_speed_of_its_touch() -> None:
    """In a short motion, the derivatives were wrong by a third: stretches ended within contacts."""
    scene = _law("Hertz with restitution")
    result = simulate(scene, 0.25, sensitivity=("contact.restitution",)).sensitivity
    assert result is not None

    def end(e: float, speed: float) -> np.ndarray:
        (vx, vy, omega), contact = scene.initial.v, replace(scene.contact, restitution=e)
        initial = replace(scene.initial, v=(vx + speed, vy, omega))
        run = simulate(replace(scene, contact=contact, initial=initial), 0.25, tol=1e-12)
        return np.concatenate([run.q[-1], run.v[-1]])

    by_e, by_speed = end(0.70001, 0.0) - end(0.69999, 0.0), end(0.7, 1e-6) - end(0.7, -1e-6)
    expected = by_e / 2e-5, by_speed / 2e-6
    derivatives = result.by_parameter["contact.restitution"][-1], result.from_start[-1][:, 3]
    for one, other in zip(derivatives, expected, strict=True):
        assert one == pytest.approx(other, abs=1e-3 * np.abs(other).max())


def test_a_restitution_that_falls_has_no_linearised_equations() -> None:
    """They lack the change of the damping number with the impact speed; the derivatives were wrong by a tenth."""
    contact = Contact("exact_restitution", 1e7, restitution=0.7)
    falls = {"restitution_fall": 0.25, "restitution_speed_m_s": 0.05}, {"restitution_fall_along_s_m": 0.2}
    assert sensitivity.fits_tangents(compile_scene(replace(preset("paper"), contact=contact), 1e-9))
    for fall in falls:
        scene = replace(preset("paper"), contact=replace(contact, **fall))
        assert not sensitivity.fits_tangents(compile_scene(scene, 1e-9))


@pytest.mark.parametrize(
    ("contact", "path"),
    [
        (Contact("exact_restitution", 1e7, restitution=1.0), "contact.restitution"),
        (Contact("hunt_crossley", 1e7, damping=MOST_DAMPING_FACTOR), "contact.damping"),
    ],
)
def test_a_largest_admissible_value_is_changed_downwards(contact: Contact, path: str) -> None:
    changed = sensitivity.ChangedScene.of(replace(preset("paper"), contact=contact), path, 1e-9)
    assert changed.change < 0.0


def test_derivatives_of_an_amplifying_motion_follow_a_more_accurate_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stiff walls amplify errors, so at the first tolerance the motion would soon be a different motion."""
    scene = replace(preset("bench_kv"), contact=Contact("kelvin_voigt", 1e9, damping=1e4))
    tolerances, follow = [], sensitivity._by_equations

    def noted(scene: Scene, t_end: float, tol: float, parameters: Sequence[str]) -> object:
        tolerances.append(tol)
        return follow(scene, t_end, tol, parameters)

    monkeypatch.setattr(sensitivity, "_by_equations", noted)
    assert sensitivity.sensitivity_of(scene, 2.0, 1e-9).growth.max() > 1e4
    assert tolerances == [1e-6, 1e-9]
    tolerances.clear()
    assert sensitivity.sensitivity_of(preset("bench_kv"), 2.0, 1e-9).trusted and tolerances == [1e-6]


def test_products_of_stretches_grow_like_their_matrices() -> None:
    """The growth agrees with matrix norms of numpy, in one call and in portions that end at various places."""
    random = np.random.default_rng(3)
    matrices = 0.5 * random.normal(size=(300, 4, 4))
    changes, ends = random.normal(size=(300, 2, 4)), random.random(300) < 0.7
    product = sensitivity.StretchProduct(4, 2)
    totals, rows, growth, logs = product.follow(matrices, changes, ends)
    since, total, row = np.zeros((0, 4, 4)), np.eye(4), np.zeros((2, 4))
    for i, (matrix, change) in enumerate(zip(matrices, changes, strict=True)):
        grown = matrix @ np.concatenate([since, np.eye(4)[None]])
        height = 4 if ends[i] else 2
        expected = max(1.0, np.linalg.norm(grown[:, :height], 2, axis=(1, 2)).max())
        assert growth[i] == pytest.approx(expected, rel=1e-6)
        assert totals[i] == pytest.approx(matrix @ total, rel=1e-9, abs=1e-300)
        assert rows[i] == pytest.approx(row @ matrix.T + change)
        if ends[i]:
            since, total, row = grown if len(grown) < 256 else grown[::2], matrix @ total, row @ matrix.T + change
    assert (logs[~ends] == 0.0).all() and logs[ends].sum() == pytest.approx(np.linalg.slogdet(matrices[ends])[1].sum())
    other = sensitivity.StretchProduct(4, 2)
    for begin in range(0, 300, 7):
        part = slice(begin, begin + 7)
        columns = other.follow(matrices[part], changes[part], ends[part])
        assert columns[0].tobytes() == totals[part].tobytes() and columns[2].tobytes() == growth[part].tobytes()


def test_a_live_twin_has_the_same_derivatives() -> None:
    scene = replace(preset("bench_kv"), initial=Initial((0.001, 0.002, 0.003), (0.1, 0.0, 0.2)))
    times = np.arange(1, 501) * 1e-3
    loads = compile_loads(scene.loads).at(times)
    paths = ("contact.stiffness", "contact.damping", "clearance.horizontal_m", "clearance.vertical_m")
    twin, alone = Twin(scene, excitation="sampled"), Twin(scene, excitation="sampled")
    followed = TwinSensitivity(twin, paths)
    for t, load in zip(times, loads, strict=True):
        followed.advance(t, load)
    alone.advance_samples(times, loads)
    assert twin.digest() == alone.digest()
    assert 0.4 < followed.t <= 0.5 and 1.0 <= followed.growth < 1e4 and np.isfinite(followed.exponent)

    def end(other: Scene) -> np.ndarray:
        moved = Twin(other, excitation="sampled", tol=1e-12)
        count = int(np.searchsorted(times, followed.t)) + 1
        rows = moved.advance_samples(times[:count], loads[:count])
        return np.concatenate([rows.q[-1], rows.v[-1]])

    values = sensitivity_parameters(scene)
    for path in paths:
        ends = [end(with_parameters(scene, {path: values[path] * (1.0 + sign * 1e-5)})) for sign in (1.0, -1.0)]
        expected = (ends[0] - ends[1]) / (2e-5 * values[path])
        assert followed.by_parameter[path] == pytest.approx(expected, abs=2e-3 * np.abs(expected).max()), path
    ends = [end(replace(scene, initial=replace(scene.initial, v=(0.1 + d, 0.0, 0.2)))) for d in (1e-6, -1e-6)]
    expected = (ends[0] - ends[1]) / 2e-6
    assert followed.from_start[:, 3] == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())
    with pytest.raises(ArgumentError, match=r"parameters: got 'loads\.fx\.scale', expected one of contact\.stiffness"):
        TwinSensitivity(twin, ("loads.fx.scale",))


# without damping, additional kernels are compiled
@pytest.mark.parametrize("e", [pytest.param(1.0, marks=pytest.mark.stress), 0.7])
def test_a_live_twin_has_the_derivative_by_restitution_without_damping(e: float) -> None:
    """At e = 1, the displaced scene is damped. An existing contact retains the damping of its touch."""
    scene = replace(preset("paper"), initial=Initial((0.001, 0.002, 0.003), (0.4, 0.1, 0.8)))
    contact = Contact("exact_restitution", scene.contact.stiffness, restitution=e, impact_speed_floor_m_s=0.05)
    scene = replace(scene, contact=contact)
    twin = Twin(scene, excitation="sampled")
    followed = TwinSensitivity(twin, ("contact.restitution",))
    times = np.arange(1, 2001) * 1e-3
    loads = np.array([2e4, -1e4, 3e3]) * np.cos(25.0 * times)[:, None]
    for t, load in zip(times, loads, strict=True):
        followed.advance(t, load)
        if followed.t > 0.2:
            break

    def end(other: Scene) -> np.ndarray:
        moved = Twin(other, excitation="sampled", tol=1e-12)
        count = int(np.searchsorted(times, followed.t)) + 1
        rows = moved.advance_samples(times[:count], loads[:count])
        assert rows.makes.sum() > 2
        return np.concatenate([rows.q[-1], rows.v[-1]])

    # the expected derivative is a one-sided difference of second order from three points
    ends = [end(with_parameters(scene, {"contact.restitution": e - d})) for d in (0.0, 1e-5, 2e-5)]
    expected = (1.5 * ends[0] - 2.0 * ends[1] + 0.5 * ends[2]) / 1e-5
    result = followed.by_parameter["contact.restitution"]
    assert followed.t > 0.2 and result == pytest.approx(expected, abs=3e-3 * np.abs(expected).max())


def test_a_scene_that_amplifies_gives_a_warning() -> None:
    hard = replace(preset("bench_kv"), contact=Contact("kelvin_voigt", 1e9, damping=1e4))
    with pytest.warns(ToleranceWarning, match=r"an error grows \S+ times, largest Lyapunov exponent"):
        result = simulate(hard, 2.0, tol=1e-9, sensitivity=True).sensitivity
    assert result is not None and result.good_until(1e-9) < result.good_until(1e-4) <= 2.0
    calm = simulate(preset("bench_kv"), 2.0, sensitivity=True).sensitivity
    assert calm is not None and calm.trusted and calm.good_until(1e-2) == 2.0
    assert simulate(preset("bench_kv"), 2.0).sensitivity is None
