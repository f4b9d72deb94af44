"""Cases for the cost of stiff walls, long motions, contact events and features."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from bench_scenes import SPARSE, T_END, bench_scene, error_scale
from cases import Array, Case, Row, pose_error
from work_precision import OURS, OURS_BARE, prepare_bare, prepare_simulate

from plow_twin import Friction, Gravity, Harmonic, Initial, Scene, sensitivity_parameters

TOL = 1e-6
HOUR_S = 3600.0


def stiffness_cases() -> Iterator[Case]:
    """Yield cases of the KV scene with soft to stiff walls and a constant damping ratio.

    The errors over 2 s are relative to our own run at a tolerance of 1e-12.
    """
    scene = bench_scene("kv")
    contact = scene.contact
    for exponent in range(5, 13):
        k = 10.0**exponent
        damping = (contact.damping or 0.0) * (k / contact.stiffness) ** 0.5
        stiff = dataclasses.replace(scene, contact=dataclasses.replace(contact, stiffness=k, damping=damping))
        row = Row("stiffness", f"kv, K={k:g} N/m", OURS_BARE, f"tol={TOL:g}", SPARSE, T_END)
        yield Case(row, partial(prepare_bare, stiff, SPARSE, TOL), _against_own(stiff, 2.0))


def _against_own(scene: Scene, t_end: float) -> Callable[[Array], float]:
    rows = round(t_end / SPARSE) + 1

    def error(q: Array) -> float:
        exact = prepare_bare(scene, SPARSE, 1e-12, t_end)().q
        assert exact is not None
        return pose_error(exact, error_scale(scene))(q[:rows])

    return error


def still_scene() -> Scene:
    """Return the KV scene without its load, in which the head falls and comes to rest."""
    return dataclasses.replace(bench_scene("kv"), loads=())


def flight_scene() -> Scene:
    """Return the KV scene without load and weight. The head is so slow that it reaches no wall within hours."""
    return dataclasses.replace(still_scene(), gravity=Gravity(0.0), initial=Initial(v=(1e-7, 1e-7, 0.0)))


def _harmonic(scene: Scene) -> Harmonic:
    (load,) = scene.loads
    assert isinstance(load, Harmonic)
    return load


def swaying_scene() -> Scene:
    """Return the KV scene without weight, with a load that is too small to move the head to a wall."""
    scene = bench_scene("kv")
    load = _harmonic(scene)
    omega = 20.0
    # initial rates of the motion without drift, x = -(F / (m omega^2)) sin(omega t)
    force = (200.0, 50.0)
    mass, inertia = scene.head.mass_kg, scene.head.inertia_kg_m2
    v = (-force[0] / (mass * omega), -force[1] / (mass * omega), -10.0 / (inertia * omega))
    swing = dataclasses.replace(load, force_n=force, moment_n_m=10.0, omega_rad_s=omega)
    return dataclasses.replace(scene, gravity=Gravity(0.0), loads=(swing,), initial=Initial(v=v))


def horizon_cases(longest: float) -> Iterator[Case]:
    """Yield cases of the KV scene with increasing length, and of scenes with hours almost without events."""
    scenes = [(bench_scene("kv"), "kv", t_end) for t_end in (1.0, 10.0, 60.0, 600.0, HOUR_S)]
    scenes += [
        (still_scene(), "at rest after the fall", HOUR_S),
        (flight_scene(), "free flight", HOUR_S),
        (swaying_scene(), "flight under a load, no wall near", HOUR_S),
    ]
    for scene, name, t_end in scenes:
        if t_end <= longest:
            row = Row("machine_time", name, OURS_BARE, f"tol={TOL:g}", t_end / 10.0, t_end)
            yield Case(row, partial(prepare_bare, scene, t_end / 10.0, TOL, t_end))


def add_steps_per_hour(rows: Sequence[Row]) -> None:
    for row in rows:
        if row.steps is not None and row.simulated_s:
            row.value = row.steps * HOUR_S / row.simulated_s


def event_cases(quick: bool) -> Iterator[Case]:
    """Yield cases with few and with many contact events in the same 20 s."""
    scene = bench_scene("kv")
    load = _harmonic(scene)
    if not quick:
        yield _event_case("free flight", flight_scene())
        yield _event_case("falls and comes to rest", still_scene())
    for omega in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0):
        driven = dataclasses.replace(scene, loads=(dataclasses.replace(load, omega_rad_s=omega),))
        yield _event_case(f"kv, omega={omega:g} rad/s", driven)


def _event_case(name: str, scene: Scene) -> Case:
    row = Row("contact_events", name, OURS_BARE, f"tol={TOL:g}", 1.0, T_END)
    return Case(row, partial(prepare_bare, scene, 1.0, TOL))


def add_steps_per_event(rows: Sequence[Row]) -> None:
    for row in rows:
        if row.steps is not None and row.events:
            row.value = row.steps / row.events


def feature_cases() -> Iterator[Case]:
    """Yield cases of the KV scene: plain, with energy balance, with friction, with both, and with derivatives."""
    scene = bench_scene("kv")
    rubbing = dataclasses.replace(scene, friction=Friction(coefficient=0.1))
    features = (("plain", scene, False), ("energy balance", scene, True), ("friction 0.1", rubbing, False))
    for name, chosen, energy_balance in (*features, ("friction 0.1 and energy balance", rubbing, True)):
        row = Row("features", f"kv, {name}", OURS, f"tol={TOL:g}", SPARSE, T_END)
        call = partial(prepare_simulate, chosen, SPARSE, tol=TOL, energy_balance=energy_balance, whole_call=True)
        yield Case(row, call)
    shared = _shared_load_scene()
    paths = tuple(sensitivity_parameters(shared))
    for name, sensitivity in (("growth of errors", True), (f"derivatives by {len(paths)} parameters", paths)):
        row = Row("features", f"kv, {name}", OURS, f"tol={TOL:g}", SPARSE, T_END)
        yield Case(row, partial(prepare_simulate, shared, SPARSE, tol=TOL, sensitivity=sensitivity, whole_call=True))


def _shared_load_scene() -> Scene:
    """Return the KV scene with its load divided into six parts, which gives ten parameters for derivatives."""
    scene = bench_scene("kv")
    load = _harmonic(scene)
    x, y = load.force_n
    part = dataclasses.replace(load, force_n=(x / 6.0, y / 6.0), moment_n_m=load.moment_n_m / 6.0)
    return dataclasses.replace(scene, loads=tuple(dataclasses.replace(part, name=f"part {i}") for i in range(6)))


def add_ratios(rows: Sequence[Row]) -> None:
    """Set the `value` of each feature row to its time relative to the first row."""
    plain = rows[0].wall_ms
    for row in rows:
        if plain and row.wall_ms is not None:
            row.value = row.wall_ms / plain
