"""Estimates with intervals and states: from a fit, from a comparison of whole motions, or from the prior alone."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from plow_twin.estimate import tuning
from plow_twin.estimate.bouncing import Bounced
from plow_twin.estimate.combined import with_apparent
from plow_twin.estimate.discrepancy import Graded, graded
from plow_twin.estimate.fit import WALLS, Fit, Problem, eliminated, scatter_ratio
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.pads import by_group, of_differences
from plow_twin.estimate.priors import UNSTATED
from plow_twin.estimate.reason import LENGTH, TIME, Reason
from plow_twin.estimate.result import NORMAL_P95, Estimate, ForcesUsed, Interval, Motion, State
from plow_twin.estimate.start import range_of_motion, reaches
from plow_twin.estimate.unknowns import (
    BIAS,
    DAMPING,
    GX,
    GY,
    LEAST_CLEARANCE,
    MOVING,
    QUANTITIES,
    SIZE,
    SOFTNESS,
    Unknowns,
)
from plow_twin.estimate.verdict import COMPONENTS, Verdict, judge_sensor, predicted
from plow_twin.model.scene import Scene

if TYPE_CHECKING:
    from plow_twin.estimate.contact_forces import ContactForces

Array = NDArray[np.float64]
#: Deviate that a correct model exceeds with a probability of 1 %, by definition.
MOST_OTHER_LAW = round(float(ndtri(0.99)), 2)
#: 95 % quantile of the absolute value of a standard normal variable, by definition.
_HALF_NORMAL_P95 = float(ndtri(0.975))
#: Words in each message of `unobserved_because`.
_UNOBSERVED = "clearance not observable:"
#: Bounds on the logarithm of a contact's penetration in m.
_LN_PENETRATIONS = (math.log(1e-9), math.log(0.12))


def summarise(problem: Problem, fit: Fit, verdict: Verdict, forces: ContactForces | None = None) -> Estimate:
    """Return the estimate from a fit and from measured contact forces, if any."""
    unknowns, poses = problem.unknowns, problem.window.poses
    finished, suspect = fit.finished, bool(verdict.model or verdict.sensor)
    plain = _plain(problem, fit)
    alone = _covariance(problem, fit, verdict, plain)
    shared, covariance = fit.shared, alone
    beside = _graded(problem, fit, verdict)
    if beside is not None:
        shared = unknowns.within(beside.shared)
        covariance = beside.covariance
        covariance[[GX, GY], [GX, GY]] += _between_optima(problem, shared) ** 2
    rough = beside is not None and (suspect or not finished or bool(verdict.added))
    deviation = np.sqrt(np.diag(covariance))
    published, spread = shared[[GX, GY]], np.tile(deviation[[GX, GY]], (2, 1))
    if beside is not None:
        published = np.maximum(beside.clearance, LEAST_CLEARANCE)
        spread = np.hypot(beside.clearance_deviation, _between_optima(problem, shared))
    # a change at an unknown time: its share in the mean over the window is uniformly distributed
    moved = verdict.changed / math.sqrt(3.0)
    deviation[[GX, GY]] = np.hypot(deviation[[GX, GY]], moved)
    spread = np.hypot(np.hypot(spread, moved), _unseen(fit))
    reasons = verdict.model + verdict.sensor + ([verdict.added] if verdict.added else [])
    if not finished and not suspect:
        gain = f"the cost would still fall by {fit.gain_left:.0f}, expected at most {tuning.OUTLYING**2:g}"
        reasons = [f"the fit has not reached an optimum: {gain}"]
    least = _least(unknowns, poses, fit, float(shared[SOFTNESS]), float(deviation[SOFTNESS]))
    seconds = _touched(fit)
    share = predicted(fit).sum(axis=0) / np.maximum(np.isfinite(fit.point.residual).sum(axis=0), 1)
    # the equations of motion couple the components: a measured component tests both clearances
    share = np.where(poses.measured, share, share[poses.measured].min())
    apparent, clearances, states = [], [], []
    untested: dict[int, Interval] = {}
    for index in (GX, GY):
        # only a predicted motion tests a clearance; hard contacts are exempt, because their bounces are unpredictable
        tested = share[index] > tuning.PREDICTED or unknowns.penetration_of(float(shared[SOFTNESS])) < tuning.HARD
        most = 2.0 * tuning.OBSERVED if rough else tuning.OBSERVED
        observed = tested and seconds[index] > tuning.TOUCHED and shared[index] > LEAST_CLEARANCE
        observed &= deviation[index] < most and (finished or rough)
        if not observed and (finished or rough) and (rough or not suspect):
            why = _wide(float(deviation[index]), most)
            if not tested:
                predictable = f"{share[index]:.0%} of {COMPONENTS[index]} is predicted"
                why = Reason(f"{predictable}, expected {tuning.PREDICTED:.0%} or more")
            elif seconds[index] <= tuning.TOUCHED:
                why = Reason(
                    "a wall is touched for {:.2g} s, expected more than {:g} s",
                    (float(seconds[index]), TIME),
                    (tuning.TOUCHED, TIME),
                )
            reasons.append(unobserved_because(index, why))
        apparent.append(Interval.normal(shared[index], deviation[index]))
        value = Interval.of_halves(published[index], *spread[:, index])
        if not observed:
            value = _unobserved(unknowns, deviation, index, least[index], fit.noise)
        clearances.append(value.above(0.0))
        states.append(state_of(suspect and not rough, observed, rough))
        if not tested:
            untested[index] = clearances[-1]
    normal = [Interval.normal(value, spread) for value, spread in zip(shared, deviation, strict=True)]
    result = Estimate(
        t_start=float(poses.t[0]),
        t_end=float(poses.t[-1]),
        horizontal=clearances[0],
        vertical=clearances[1],
        horizontal_state=states[0],
        vertical_state=states[1],
        **_numbers(unknowns, normal),
        noise=(float(fit.noise[0]), float(fit.noise[1]), float(fit.noise[2])),
        model="suspect" if verdict.model or verdict.added else "ok",
        sensor="suspect" if verdict.sensor else "ok",
        reasons=tuple(reasons),
        apparent=(apparent[0], apparent[1])
        if all(state.known for state in states) and not np.allclose(spread, deviation[[GX, GY]])
        else None,
        load_harmonics=None if beside is None else beside.harmonics,
        groups=_groups(
            problem, fit, float(np.sqrt(alone[GX, GX] / plain[GX, GX])), states, untested, shared, covariance - alone
        ),
        differs={} if beside is None else beside.differs,
        correlation=_correlation(covariance),
        figures={
            **verdict.figures,
            **_figures(beside),
            "iterations": float(fit.iterations),
            "gain_left": fit.gain_left,
            "work": float(problem.forward.work),
        },
        motion=Motion(poses.t, poses.q, fit.point.predicted + fit.shared[BIAS]),
    )
    if forces is None:
        return result
    return _with_forces(result, problem, fit, forces, _widened(problem, fit, verdict))


def _with_forces(result: Estimate, problem: Problem, fit: Fit, forces: ContactForces, widened: float) -> Estimate:
    from plow_twin.estimate.force_fit import fit_jointly

    if "suspect" in (result.model, result.sensor) or not fit.finished:
        return replace(result, forces_measured=ForcesUsed(unused="the fit of the poses fails a check"))
    joint = fit_jointly(problem, fit, forces, widened)
    result = replace(result, forces_measured=joint.used)
    if joint.model or joint.sensor:
        return result.having(
            result.clearances,
            (State.WITHDRAWN, State.WITHDRAWN),
            model="suspect" if joint.model else "ok",
            sensor="suspect" if joint.sensor else "ok",
            reasons=(*result.reasons, *joint.model, *joint.sensor),
        )
    if joint.shared is None or joint.covariance is None:
        return result
    covariance = joint.covariance
    covariance[[GX, GY], [GX, GY]] += _between_optima(problem, joint.shared) ** 2
    deviation = np.sqrt(np.diag(covariance))
    normal = [Interval.normal(value, spread) for value, spread in zip(joint.shared, deviation, strict=True)]
    apparent = tuple(
        new if state is State.ESTIMATED else old
        for state, old, new in zip(result.states, result.in_scene_frame(), (normal[GX], normal[GY]), strict=True)
    )
    return replace(
        with_apparent(result, apparent), **_numbers(problem.unknowns, normal), correlation=_correlation(covariance)
    )


def _graded(problem: Problem, fit: Fit, verdict: Verdict) -> Graded | None:
    """Return the result of the fit for a machine that may differ from the model, or None in these cases:

    - The measurements contradict each other.
    - Swings are linked, and either no check fails or the fit has not reached an optimum.
    - The fit has not reached an optimum, and its residuals far exceed the noise.
    """
    if verdict.broken:
        return None
    clean = not fails(fit, verdict)
    if len(problem.link) and (clean or not fit.finished):
        return None
    inflation = if_it_differs(problem, fit, doubtful=not clean)
    if inflation is None or (not fit.finished and inflation.inflation.mean() >= tuning.MOST_INFLATED):
        return None
    return inflation


def if_it_differs(problem: Problem, fit: Fit, doubtful: bool = True) -> Graded | None:
    """Return the result of `graded`; None if its equations cannot be solved."""
    try:
        return graded(problem, fit, doubtful)
    except np.linalg.LinAlgError:
        return None


def _plain(problem: Problem, fit: Fit) -> Array:
    """Return the covariance without the misfit: noise, and uncertainty of the differences in the fit."""
    return fit.covariance + of_differences(problem, fit) if problem.differences.any() else fit.covariance


def _covariance(problem: Problem, fit: Fit, verdict: Verdict, plain: Array) -> Array:
    """Return the covariance `plain` of the shared unknowns, widened by the misfit and by the fit's next step."""
    size = len(fit.shared)
    covariance: Array = plain * _widened(problem, fit, verdict) + np.outer(fit.left[:size], fit.left[:size])
    covariance[[GX, GY], [GX, GY]] += _between_optima(problem, fit.shared) ** 2
    return covariance


def _widened(problem: Problem, fit: Fit, verdict: Verdict) -> float:
    """Return the factor on the variance of the noise from the scatter of the swings and the colour of the residuals.

    The colour multiplies the deviation, because coloured residuals stay correlated for long.
    """
    ratio = 1.0 if len(problem.link) else max(1.0, _scatter(problem, fit, np.diag(fit.covariance)))
    colour = max(verdict.figures.get(f"colour_{name}", 1.0) for name in COMPONENTS)
    widened = max(1.0, colour) * (1.0 if fit.converged else tuning.UNFINISHED)
    return widened**2 * ratio


def _between_optima(problem: Problem, shared: Array) -> float:
    """Return the standard deviation of a clearance in m over optima that explain the motion equally well.

    Hard contacts, and motions of which only one component was measured, have several optima.
    """
    unknowns = problem.unknowns
    if problem.window.poses.measured.sum() == 1:
        return tuning.OPTIMA[2]
    if unknowns.is_hard(shared):
        return tuning.OPTIMA[0]
    return tuning.OPTIMA[1] if unknowns.penetration_of(float(shared[SOFTNESS])) < tuning.FIRM else 0.0


def _scatter(problem: Problem, fit: Fit, variance: Array) -> float:
    precision, swings = 1.0 / problem.deviation**2, list(eliminated(problem, fit))
    normal: Array = sum((swing.normal for swing in swings), np.diag(precision))
    inverse = np.asarray(np.linalg.inv(normal), np.float64)
    scores = np.stack([swing.score for swing in swings]) if swings else np.zeros((1, SIZE))
    return scatter_ratio(scores, precision, inverse, variance, problem.window.swings)


def _touched(fit: Fit) -> Array:
    """Return the time in s in contact with the less touched of two opposite walls, horizontal and vertical."""
    left, right, top, bottom = (fit.point.contact[:, pads].sum() for pads in WALLS.values())
    return np.array([min(left, right), min(top, bottom)])


def _least(unknowns: Unknowns, poses: Poses, fit: Fit, softness: float, deviation: float) -> Array:
    """Return lower bounds on the clearances in m, shape (2,): the range of motion minus the penetrations of both walls.

    The penetration of a wall that the head does not touch is at most that of the opposite wall. Before an optimum, the
    penetrations of the fit mean nothing.
    """
    wider = math.exp(NORMAL_P95 * min(deviation, 1.0))
    if fit.finished:
        deepest = np.nanmax(reaches(unknowns.scene, fit.point.predicted), axis=0).reshape(2, 2).max(axis=1)
        uncertainty = 2.0 * wider * np.maximum(deepest - 0.5 * fit.shared[[GX, GY]], 0.0)
    else:
        uncertainty = np.full(2, tuning.GIVEN * wider * math.exp(softness))
    least: Array = range_of_motion(unknowns.scene, poses.moved(-fit.shared[BIAS]))[0] - uncertainty
    return least


def _unseen(fit: Fit) -> Array:
    """Return the standard deviation of clearances in m, shape (2,), due to rotations of walls with an untouched pad.

    The motion does not show the position of such a pad, and the linearised fit ignores this uncertainty.
    """
    square = np.zeros(2)
    seconds = fit.point.contact.sum(axis=0)
    for side, pads in WALLS.items():
        if seconds[list(pads)].min() < tuning.TOUCHED:
            square[GX if side in ("left", "right") else GY] += (0.5 * UNSTATED[f"turn_{side}"]) ** 2
    return np.sqrt(square)


def _groups(
    problem: Problem,
    fit: Fit,
    widened: float,
    states: list[State],
    untested: dict[int, Interval],
    shared: Array,
    added: Array,
) -> dict[str, tuple[Interval, State]]:
    """Return clearance and state of each group of facing pads, for a frame of exactly the scene's size.

    `widened` is a factor on the standard deviations of the fit. The clearances `untested`, by the index of the axis,
    replace those between pads if no predicted motion tests them. `shared` are the unknowns of a machine that may differ
    from the model, and `added` is their covariance minus that of the fit.
    """
    out = {}
    for name, (value, deviation) in by_group(problem, fit, widened).items():
        axis = GX if name.startswith("horizontal") else GY
        state = states[axis]
        whole = math.sqrt(deviation**2 + max(float(added[axis, axis]), 0.0))
        if state.known and whole > 0.5 * tuning.OBSERVED:
            state = State.NOT_OBSERVABLE
        share_above = Interval.normal(value.mean + float(shared[axis] - fit.shared[axis]), whole).above(0.0)
        out[name] = untested.get(axis, share_above), state
    return out


def _figures(beside: Graded | None) -> dict[str, float]:
    if beside is None:
        return {}
    named = zip(("fx", "fy", "m"), beside.load.tolist(), strict=True)
    noise = zip(COMPONENTS, beside.inflation.tolist(), strict=True)
    return {
        "surprise": beside.surprise,
        **{f"load_error_{name}": value for name, value in named},
        **{f"inflation_{name}": value for name, value in noise},
    }


def _correlation(covariance: Array) -> tuple[tuple[float, ...], ...]:
    moving = covariance[np.ix_(MOVING, MOVING)]
    deviation = np.sqrt(np.diag(moving))
    matrix = moving / np.outer(deviation, deviation)
    return tuple(tuple(row) for row in matrix.tolist())


def _unobserved(unknowns: Unknowns, deviation: Array, index: int, reach: float, noise: Array) -> Interval:
    """Return the interval of a clearance that is not observed: the prior above the range of motion `reach`."""
    nominal, spread = unknowns.nominal()[index], max(unknowns.deviations()[index], deviation[index])
    return Interval.normal(nominal, spread).above(reach - 3.0 * float(np.hypot(noise[index], 1e-4)))


def _wide(deviation: float, most: float) -> Reason:
    return Reason("deviation of {:.2g} m, expected less than {:g} m", (deviation, LENGTH), (most, LENGTH))


def unobserved_because(index: int, why: Reason) -> Reason:
    """Return the message that the motion does not determine a clearance."""
    return why.after(f"{'horizontal' if index == GX else 'vertical'} {_UNOBSERVED} ")


def without_unobserved(reasons: tuple[str, ...]) -> list[str]:
    """Return the reasons that are not from `unobserved_because`."""
    return [reason for reason in reasons if _UNOBSERVED not in reason]


def state_of(withdrawn: bool, observed: bool, rough: bool = False) -> State:
    """Return the state of a clearance."""
    if withdrawn:
        return State.WITHDRAWN
    published = State.ROUGH if rough else State.ESTIMATED
    return published if observed else State.NOT_OBSERVABLE


def summarise_bounced(
    unknowns: Unknowns, poses: Poses, bounced: Bounced, work: int, first: Fit | None = None
) -> Estimate:
    """Return the estimate for a hard contact. It was found by comparing simulated motions with the measured motion.

    All simulated motions touch all walls. If the motion of the fit `first` does not touch a wall, the clearance is not
    observable.
    """
    sensor, touched = judge_sensor(poses), np.ones(2) if first is None else _touched(first)
    distances = (
        ("motion", bounced.distance, tuning.MOST_DISTANCE),
        ("path over the load's period", bounced.path, tuning.MOST_PATH),
    )
    model = [
        f"{name} unlike the model's: distance {value:.1f}, expected at most {most:g}"
        for name, value, most in distances
        if value > most
    ]
    if bounced.law > MOST_OTHER_LAW and not -math.inf < bounced.odds < tuning.MOST_ODDS[1]:
        model.append(f"motion like that of another contact law: {bounced.law:.1f}, expected at most {MOST_OTHER_LAW:g}")
    if bounced.odds > tuning.MOST_ODDS[0]:
        odds = f"ln odds {bounced.odds:.1f}, expected at most {tuning.MOST_ODDS[0]:g}"
        model.append(f"motion likely under another contact law: {odds}")
    reasons = list(sensor or model)
    beyond = max(1.0, *(value / most for _, value, most in distances)) if model else 0.0
    apparent, clearances, states = [], [], []
    for index in (GX, GY):
        deviation = math.hypot(bounced.clearance_deviation[index], beyond * tuning.UNEXPLAINED_HARD)
        rough = bool(model) or deviation > tuning.BOUNCED_MOST
        value = Interval.normal(float(bounced.clearance[index]), deviation)
        apparent.append(value)
        value = Interval.normal(value.mean, math.hypot(deviation, bounced.unseen[index]))
        lowest = math.hypot(value.mean - value.p05, _HALF_NORMAL_P95 * bounced.rounded[index])
        value = replace(value, p05=value.mean - lowest)
        observed = deviation < 2.0 * tuning.OBSERVED and bounced.clearance[index] > LEAST_CLEARANCE
        observed &= bool(touched[index] > 0.0 and bounced.follows[index] > tuning.FOLLOWS)
        # walls that are not touched make the other clearance uncertain too
        observed &= not rough or bool(bounced.follows.min() > tuning.FOLLOWS)
        if not observed:
            why = _wide(deviation, 2.0 * tuning.OBSERVED)
            if touched[index] <= 0.0:
                why = Reason("a wall is never touched")
            elif bounced.follows.min() <= tuning.FOLLOWS:
                follows = f"the reach follows {bounced.follows.min():.0%} of a clearance"
                why = Reason(f"{follows}, expected {tuning.FOLLOWS:.0%}")
            reasons.append(unobserved_because(index, why))
            value = _unobserved(unknowns, np.zeros(2), index, 0.0, bounced.noise)
        clearances.append(value.above(0.0))
        states.append(state_of(bool(sensor), observed, rough))
    exponent = unknowns.scene.contact.exponent
    log = Interval.normal(*bounced.ln_penetration)
    # the extrapolation of a regression is not bounded
    log = Interval(*np.clip([log.mean, log.p05, log.p95], *_LN_PENETRATIONS).tolist())
    mean, soft, hard = (unknowns.force / np.exp(value) ** exponent for value in (log.mean, log.p95, log.p05))
    bias = [Interval.normal(*pair) for pair in zip(bounced.bias, bounced.bias_deviation, strict=True)]
    return Estimate(
        t_start=float(poses.t[0]),
        t_end=float(poses.t[-1]),
        horizontal=clearances[0],
        vertical=clearances[1],
        horizontal_state=states[0],
        vertical_state=states[1],
        apparent=(apparent[0], apparent[1]) if all(state.known for state in states) else None,
        # bounces determine only a lower limit of the stiffness
        stiffness=Interval(float(mean), float(soft), max(float(hard), unknowns.hardest_stiffness)),
        damping=damping_interval(unknowns, Interval.normal(*bounced.ln_damping)),
        bias_x=bias[0],
        bias_y=bias[1],
        bias_theta=bias[2],
        noise=(float(bounced.noise[0]), float(bounced.noise[1]), float(bounced.noise[2])),
        model="suspect" if model and not sensor else "ok",
        sensor="suspect" if sensor else "ok",
        reasons=tuple(reasons),
        figures={
            "distance": bounced.distance,
            "path": bounced.path,
            "law": bounced.law,
            **({"law_odds": bounced.odds} if math.isfinite(bounced.odds) else {}),
            "work": float(work),
        },
    )


def _numbers(unknowns: Unknowns, normal: list[Interval]) -> dict[str, Any]:
    # the unit of the stiffness depends on the exponent
    unknowns = replace(unknowns, scene=unknowns.nominal_scene or unknowns.scene)
    values = {quantity.name: value for quantity, value in zip(QUANTITIES, normal, strict=True)}
    del values["horizontal"], values["vertical"]
    contact = {
        "stiffness": _stiffness(unknowns, normal[SOFTNESS]),
        "damping": damping_interval(unknowns, normal[DAMPING]),
    }
    return values | contact


def _stiffness(unknowns: Unknowns, psi: Interval) -> Interval:
    """Return the stiffness from the softness `psi`.

    The interval extends to `Unknowns.hardest_stiffness` if it includes contacts that are too hard to be resolved.
    """
    soft, hard = unknowns.stiffness_of(psi.p95), unknowns.stiffness_of(psi.p05)
    if unknowns.within(np.full(SIZE, psi.p05))[SOFTNESS] > psi.p05:
        hard = max(hard, unknowns.hardest_stiffness)
    return Interval(unknowns.stiffness_of(psi.mean), soft, hard)


def damping_interval(unknowns: Unknowns, value: Interval) -> Interval | None:
    """Return the interval of the damping from that of its unknown; None without a damping."""
    if not unknowns.damped:
        return None
    numbers = [unknowns.damping_of(number) for number in (value.mean, value.p05, value.p95)]
    return Interval(*numbers)


def priors(scene: Scene, load: Load, poses: Poses) -> dict[str, Interval]:
    """Return the prior of each quantity in SI units, by the names of `QUANTITIES`."""
    unknowns = Unknowns.stated(scene, load, poses)
    normal = [Interval.normal(*pair) for pair in zip(unknowns.nominal(), unknowns.deviations(), strict=True)]
    numbers = {name: value for name, value in _numbers(unknowns, normal).items() if value is not None}
    return {"horizontal": normal[GX].above(0.0), "vertical": normal[GY].above(0.0), **numbers}


def prior_of(unknowns: Unknowns, span: tuple[float, float]) -> Estimate:
    """Return the prior as an estimate."""
    nominal, spread = unknowns.nominal(), unknowns.deviations()
    horizontal, vertical = (Interval.normal(nominal[i], spread[i]).above(0.0) for i in (GX, GY))
    psi = Interval.normal(nominal[SOFTNESS], spread[SOFTNESS])
    return Estimate(*span, horizontal, vertical, State.PRIOR, State.PRIOR, stiffness=_stiffness(unknowns, psi))


def not_observable(unknowns: Unknowns, poses: Poses, reasons: tuple[str, ...]) -> Estimate:
    """Return the prior as an estimate whose clearances are not observable."""
    nothing, unseen = prior_of(unknowns, (float(poses.t[0]), float(poses.t[-1]))), State.NOT_OBSERVABLE
    return nothing.having(nothing.clearances, (unseen, unseen), reasons=reasons)


def without_fit(
    unknowns: Unknowns, poses: Poses, reason: str = "no motion of the model is near the measured motion"
) -> Estimate:
    """Return the prior as a withdrawn estimate."""
    nothing, withdrawn = prior_of(unknowns, (float(poses.t[0]), float(poses.t[-1]))), State.WITHDRAWN
    return nothing.having(nothing.clearances, (withdrawn, withdrawn), model="suspect", reasons=(reason,))


def contradictory(unknowns: Unknowns, poses: Poses, reasons: tuple[str, ...]) -> Estimate:
    """Return the prior as an estimate that is withdrawn because the poses contradict the load."""
    return replace(without_fit(unknowns, poses), model="ok", sensor="suspect", reasons=reasons)


def fails(fitted: Fit, verdict: Verdict) -> bool:
    """Return whether a fit fails a check or has not reached an optimum."""
    return bool(verdict.model or verdict.sensor) or not fitted.finished
