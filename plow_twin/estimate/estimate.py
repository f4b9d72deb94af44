"""Estimate of clearances, contact, load gains and sensor errors from one window of measurements."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from plow_twin.estimate import tuning
from plow_twin.estimate.block import estimate_block
from plow_twin.estimate.bouncing import Bounced, bias_of_hard, bounces, by_range, compare
from plow_twin.estimate.discrepancy import Graded, graded, variants
from plow_twin.estimate.fit import Fit, Problem, freed
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.gaps import Gaps, GapsFit, fit_gaps
from plow_twin.estimate.lacking import with_harmonics
from plow_twin.estimate.measurements import FEWEST_POSES, Load, Poses, filled, useless_deviation
from plow_twin.estimate.pads import by_group, of_differences, shown, with_differences
from plow_twin.estimate.priors import UNSTATED
from plow_twin.estimate.result import NORMAL_P95, Estimate, ForcesUsed, Interval, Motion, State
from plow_twin.estimate.search import LOW_PASS, behind_low_pass, candidate, refine
from plow_twin.estimate.similar import Units
from plow_twin.estimate.start import noise_level, range_of_motion
from plow_twin.estimate.uncertain_load import compare_under_uncertain_load
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
    with_other_law,
)
from plow_twin.estimate.unmeasured import fit_some_components
from plow_twin.estimate.verdict import COMPONENTS, Verdict, judge, judge_sensor, predicted, sandwich
from plow_twin.kernel.low_pass import lagged
from plow_twin.model import geometry
from plow_twin.model.scene import Gravity, Scene
from plow_twin.solve.compiled_scene import inertias

if TYPE_CHECKING:
    from plow_twin.estimate.contact_forces import ContactForces

Array = NDArray[np.float64]
#: First guess for a fit from the previous window: the unknowns of the whole window, the noise, and the differences from
#: the model; empty without a guess.
Guess = tuple[float, ...]

#: Upper bounds on the length of a window, in load periods and in s, of which the longer applies.
MOST_PERIODS, MOST_SPAN_S = 20.0, 60.0
#: Upper bound in s on the length of the data in which the period of the load is searched, the longest window of a node.
_LONGEST_S = 600.0
#: Deviate that a correct model exceeds with a probability of 1 %, by definition.
MOST_OTHER_LAW = round(float(ndtri(0.99)), 2)
#: 95 % quantile of the absolute value of a standard normal variable, by definition.
_HALF_NORMAL_P95 = float(ndtri(0.975))
#: Bounds on the logarithm of a contact's penetration in m.
_LN_PENETRATIONS = (math.log(1e-9), math.log(0.12))
#: Definition of the walls of the cavity by the indices of the two pairs at each wall.
_SIDES = {"left": (1, 7), "right": (3, 5), "top": (0, 2), "bottom": (4, 6)}


def estimate(
    scene: Scene,
    load: Load,
    poses: Poses,
    lost: int = 0,
    gaps: Gaps | None = None,
    forces: ContactForces | None = None,
) -> Estimate:
    """Return the estimate of clearances, contact, load gains, and the sensor's bias and delay from a window.

    Parameters
    ----------
    scene : Scene
        The nominal scene. Its geometry, masses and gravity are assumed to be exact; its clearances and contact
        parameters are the means of the prior.
    load : Load
        The measured load.
    poses : Poses
        The measured poses.
    lost : int
        Number of rows that were left out before.
    gaps : Gaps, optional
        Measured gaps, from which the clearances and, without measured poses, the poses are computed.
    forces : ContactForces, optional
        Measured contact forces, which determine the contact more accurately than the motion alone.
    """
    return estimate_window(scene, load, poses, lost, gaps=gaps, forces=forces)[0]


def estimate_window(
    scene: Scene,
    load: Load,
    poses: Poses,
    lost: int = 0,
    guess: Guess = (),
    gaps: Gaps | None = None,
    forces: ContactForces | None = None,
) -> tuple[Estimate, Guess]:
    """Return the result of `estimate` for a window, and the guess for the next window.

    The fit starts from `guess`, if any. If it fails a check, the estimate is repeated with a full search.
    """
    if scene.head.carries == "corners":
        span = (float(load.t[0]), float(load.t[-1]))
        poses = poses.between(span[0], span[1] + 1e-9)
        return estimate_block(scene, load, poses, prior_of(Unknowns.stated(scene, load, poses), span, lost)), ()
    units = Units.of(scene, load)
    if units == Units():
        return _estimate(scene, load, poses, lost, guess, gaps, forces)
    its = units.load(load), units.poses(poses)
    found, following = _estimate(units.scene(scene), *its, lost, guess, units.gaps(gaps), units.forces(forces))
    found = units.in_si(found, scene)
    if units.only_time and found.sensor == "ok":
        # the duration of an impact does not depend on the load's period, so repeat with times in s
        period = _period(load, poses)
        unknowns = Unknowns.stated(scene, load, poses)
        found = under_uncertain_load(found, unknowns, thinned(load, period)[0], poses, period)
    return found, following


def _estimate(
    scene: Scene,
    load: Load,
    poses: Poses,
    lost: int,
    guess: Guess,
    gaps: Gaps | None,
    forces: ContactForces | None,
) -> tuple[Estimate, Guess]:
    """Return the result of `estimate_window`, with all numbers in the units of the arguments."""
    known, measured = len(load.t), len(poses.t)
    load = load.longest_stretch()
    lost += known - len(load.t)
    span = float(load.t[0]), float(load.t[-1])
    poses = poses.between(span[0], span[1] + 1e-9)
    if len(load.t) < known:
        lost += measured - len(poses.t)
    load = load.newest(_LONGEST_S)
    load = load.newest(max(MOST_PERIODS * (load.oscillation() or 0.0), MOST_SPAN_S))
    span = float(load.t[0]), span[1]
    poses = poses.between(span[0], span[1] + 1e-9).fresh()
    poses, spikes = poses.without_spikes(noise_level(filled(poses)))
    lost += spikes
    by_gaps = None if gaps is None else fit_gaps(scene, gaps.between(span[0], span[1] + 1e-9), poses)
    if isinstance(by_gaps, GapsFit) and len(by_gaps.poses.t) and (len(poses.t) < FEWEST_POSES or _lacking(poses)):
        poses = by_gaps.poses
    if forces is not None:
        forces = forces.between(span[0], span[1] + 1e-9)
    try:
        result, following = _from_motion(scene, load, poses, lost, guess, forces)
        if _unexplained(result) and load.interval() > tuning.COARSEST:
            smooth = load.smooth(0.1 * tuning.COARSEST)
            other, following = _from_motion(scene, smooth, poses, lost, (), forces)
            why = f"load: a sample every {load.interval():.2g} s, expected {tuning.COARSEST:g} s; taken as averages"
            result = replace(other, reasons=(why, *other.reasons)) if _known(other) else result
    except (np.linalg.LinAlgError, OverflowError) as error:
        result, following = _without_fit(Unknowns(scene), poses, lost, f"the fit cannot be computed: {error}"), ()
    if forces is not None and result.forces_measured is None:
        result = replace(result, forces_measured=ForcesUsed(unused="the motion is not known moment by moment"))
    if isinstance(by_gaps, GapsFit):
        result = with_gaps(result, by_gaps)
    elif by_gaps is not None:
        result = replace(result, reasons=(*result.reasons, by_gaps))
    return result, following


def _known(result: Estimate) -> bool:
    return result.horizontal_state.known or result.vertical_state.known


def _unexplained(result: Estimate) -> bool:
    return result.model == "suspect" and not _known(result)


def _from_motion(
    scene: Scene, load: Load, poses: Poses, lost: int, guess: Guess, forces: ContactForces | None
) -> tuple[Estimate, Guess]:
    span = float(load.t[0]), float(load.t[-1])
    unknowns = Unknowns.stated(scene, load, poses)
    if len(poses.t) < FEWEST_POSES:
        few = (
            f"got {len(poses.t)} poses within the load's span, {span[0]:g} s to {span[1]:g} s, expected at least "
            f"{FEWEST_POSES}"
        )
        return replace(prior_of(unknowns, span, lost), reasons=(few,)), ()
    lacking = _lacking(poses)
    some = _well_measured(poses)
    if some is not None and not _is_dead(load, some):
        return _from_some_components(unknowns, load, some, lost, lacking), ()
    if lacking:
        return _not_observable(unknowns, poses, lost, lacking), ()
    if _is_dead(load, poses):
        return _without_load(unknowns, load, poses, lost), ()
    if _is_idle(scene, load, poses):
        return _not_observable(unknowns, poses, lost, ("the head rests under a load that hardly changes",)), ()
    if _rests(poses):
        return _without_fit(
            unknowns, poses, lost, "the head rests under a load that changes: the head or its sensor is stuck"
        ), ()
    period = _period(load, poses)
    felt, broad = thinned(load, period)
    drift = tuning.LEFT_OPEN * np.array(felt.unknown) / np.asarray(inertias(scene)) ** 2 if broad else None
    forward = Forward(scene, felt)
    if guess:
        numbers = np.array(guess)
        shared, noise, differences = np.split(numbers, [SIZE, SIZE + 3])
        # the guess for a contact harder than `FITTED` is not from a fit
        certain = unknowns.penetration_of(float(shared[SOFTNESS])) > tuning.FITTED
        near = refine(forward, unknowns, poses, period, unknowns.within(shared), noise, drift, differences, certain)
        verdict = judge(*near, period) if near else None
        if near and verdict and not _fails(near[1], verdict):
            near, verdict = _with_differences(near, verdict, period)
            return summarise(*near, verdict, lost, forces), _next_guess(*near)
        forward = Forward(scene, felt)
    bias = bias_of_hard(unknowns, poses)
    if bias.any():
        result, following = _searched(forward, unknowns, poses.moved(-bias), period, drift, lost, forces)
        if following:
            numbers = np.array(following)
            numbers[BIAS] += bias
            following = tuple(numbers.tolist())
        return _moved_back(result, bias), following
    return _searched(forward, unknowns, poses, period, drift, lost, forces)


def _without_load(unknowns: Unknowns, load: Load, poses: Poses, lost: int) -> Estimate:
    """Return the estimate from the poses alone, without a measured load.

    The range of motion is the clearance plus the penetrations at two opposite walls, which are estimated from the
    equations of motion for walls that yield.
    """
    nothing = _without_fit(unknowns, poses, lost, "load: the same value throughout, while the head moves")
    bias = bias_of_hard(unknowns, poses)
    poses = poses.moved(-bias)
    if bounces(unknowns, poses):
        found = summarise_bounced(unknowns, poses, by_range(unknowns, poses), lost, 0)
        return replace(_moved_back(found, bias), model="suspect", reasons=(*nothing.reasons, *found.reasons))
    return under_uncertain_load(nothing, unknowns, None, poses, float(poses.t[-1] - poses.t[0]) / 10.0)


def _from_some_components(
    unknowns: Unknowns, load: Load, poses: Poses, lost: int, lacking: tuple[str, ...]
) -> Estimate:
    """Return the estimate from poses in which one or two components were never measured."""
    period = _period(load, poses)
    felt, _ = thinned(load, period)
    share, time = tuning.UNMEASURED_LOAD
    drift = 2.0 * time * (share * load.wrench.std(axis=0) / np.asarray(inertias(unknowns.scene))) ** 2
    found = fit_some_components(Forward(unknowns.scene, felt), unknowns, poses, period, drift)
    if found is not None:
        result = summarise(*found, judge(*found, period), lost)
        if _known(result):
            return replace(result, reasons=(*lacking, *result.reasons))
    if poses.measured[:2].all():
        nothing = replace(prior_of(unknowns, (float(poses.t[0]), float(poses.t[-1])), lost), reasons=lacking)
        return under_uncertain_load(nothing, unknowns, felt, poses, period)
    return _not_observable(unknowns, poses, lost, lacking)


def _searched(
    forward: Forward,
    unknowns: Unknowns,
    poses: Poses,
    period: float,
    drift: Array | None,
    lost: int,
    forces: ContactForces | None,
) -> tuple[Estimate, Guess]:
    """Return the estimate from a search or from the comparison of whole motions, without a guess."""
    narrow = bounces(unknowns, poses)
    bounced = compare(forward, unknowns, poses, period) if narrow else None
    searched = candidate(forward, unknowns, poses, period) if bounced is None else None
    first = None if searched is None else searched[1]
    if first is not None:
        penetration = unknowns.penetration_of(float(first.shared[SOFTNESS]))
        if penetration < tuning.CERTAINLY_HARD and not narrow:
            bounced = compare(forward, unknowns, poses, period)
        if bounced is None and penetration < tuning.HARD:
            bounced = compare(forward, unknowns, poses.moved(-first.shared[BIAS]), period, first.shared)
            bounced = bounced and replace(bounced, bias=bounced.bias + first.shared[BIAS])
    if bounced is not None and (first is None or bounced.ln_penetration[0] < math.log(tuning.FITTED)):
        return summarise_bounced(unknowns, poses, bounced, lost, forward.work), ()
    if first is None:
        return under_uncertain_load(_without_fit(unknowns, poses, lost), unknowns, forward.load, poses, period), ()
    start = first.shared if bounced is None else _from_bounced(unknowns, first.shared, bounced)
    spent, forward = forward.work, forward.renewed() if bounced else forward
    found = refine(forward, unknowns, poses, period, start, first.noise, drift, close=bounced is not None)
    if bounced is not None and (found is None or not found[1].finished):
        return summarise_bounced(unknowns, poses, bounced, lost, spent + forward.work), ()
    if found is None:
        return under_uncertain_load(_without_fit(unknowns, poses, lost), unknowns, forward.load, poses, period), ()
    verdict, plain = judge(*found, period), found
    behind = behind_low_pass(*searched) if searched and _fails(found[1], verdict) and not verdict.broken else None
    if behind is not None:
        again = refine(forward.renewed(), unknowns, poses, period, behind.shared, behind.noise, drift, LOW_PASS)
        if again and again[1].loss < found[1].loss:
            found, verdict = again, judge(*again, period)
    found, verdict = _with_differences(found, verdict, period)
    if bounced is None and _fails(found[1], verdict) and not verdict.sensor:
        # a low pass of the sensor or a change of the machine can resemble harmonics
        found, verdict = with_harmonics(*plain, forward.load, period) or (found, verdict)
    result = summarise(*found, verdict, lost, forces if bounced is None else None)
    if bounced is None and _fails(found[1], verdict) and not verdict.broken:
        result = under_uncertain_load(result, unknowns, forward.load, poses, period, found)
    following = () if verdict.model or verdict.sensor or verdict.lacking else _next_guess(*found)
    return result if bounced is None else with_bounced(result, bounced, spent), following


def _period(load: Load, poses: Poses) -> float:
    return min(load.period(), float(poses.t[-1] - poses.t[0]))


def _fails(found: Fit, verdict: Verdict) -> bool:
    return bool(verdict.model or verdict.sensor) or not found.finished


def under_uncertain_load(
    result: Estimate,
    unknowns: Unknowns,
    felt: Load | None,
    poses: Poses,
    period: float,
    fitted: tuple[Problem, Fit] | None = None,
) -> Estimate:
    """Replace the withdrawn clearances of the estimate `result` by values that allow for errors of the load.

    The values come from a comparison with motions under uncertain loads. `fitted` is a fit that failed a check. Its
    clearances are combined with those of the comparison where they agree.
    """
    if _known(result) or (felt is not None and felt.interval() > tuning.COARSEST):
        return result
    found, work = compare_under_uncertain_load(felt, unknowns, poses, period)
    figures = result.figures | {"work": result.figures.get("work", 0.0) + float(work)}
    if found is None or found.distance > tuning.MOST_DISTANCE or found.ln_depth[0] < math.log(tuning.FITTED):
        return replace(result, figures=figures)
    beside = None if fitted is None else _if_it_differs(*fitted)
    values, known = [], []
    for index in (GX, GY):
        prior = float(unknowns.nominal()[index]), float(unknowns.deviations()[index])
        mean, deviation = _both((float(found.clearance[index]), float(found.deviation[index])), prior)
        if beside is not None:
            by_fit = float(beside.shared[index]), math.sqrt(beside.covariance[index, index])
            if _apart((mean, deviation), by_fit) < tuning.AGREES:
                mean, deviation = _both_of_one((mean, deviation), by_fit)
        observed = bool(found.touched[index]) and deviation < tuning.OBSERVED_SHARE * prior[1]
        values.append(Interval.normal(*((mean, deviation) if observed else prior)).above(0.0))
        known.append(_state(False, observed, rough=True))
    exponent = unknowns.scene.contact.exponent
    log = Interval.normal(*found.ln_depth)
    mean, soft, hard = (unknowns.force / math.exp(value) ** exponent for value in (log.mean, log.p95, log.p05))
    return replace(
        result,
        horizontal=values[0],
        vertical=values[1],
        horizontal_state=known[0],
        vertical_state=known[1],
        stiffness=Interval(mean, soft, hard),
        damping=_damping(unknowns, Interval.normal(*found.ln_damping)),
        correlation=None,
        groups={},
        figures=figures | {"distance": found.distance, "load_error": found.load_error},
    )


def _from_bounced(unknowns: Unknowns, shared: Array, bounced: Bounced) -> Array:
    start = shared.copy()
    start[[GX, GY]], start[DAMPING] = bounced.clearance, bounced.ln_damping[0]
    penetration = math.exp(bounced.ln_penetration[0])
    start[SOFTNESS] = unknowns.softness_of(unknowns.force / penetration**unknowns.scene.contact.exponent)
    return unknowns.within(start)


def with_bounced(result: Estimate, bounced: Bounced, spent: int) -> Estimate:
    """Return an estimate that combines the results of a fit and of a comparison; disagreement widens the intervals."""
    figures = result.figures | {"distance": bounced.distance, "path": bounced.path}
    figures["work"] += float(spent)
    if bounced.distance >= tuning.MOST_DISTANCE:
        return replace(result, figures=figures)
    apparent = tuple(
        Interval.normal(*_both_of_one((value.mean, value.deviation), (mean, deviation)))
        if state is State.ESTIMATED and deviation < tuning.OBSERVED
        else value
        for value, state, mean, deviation in zip(
            result.in_scene_frame(),
            (result.horizontal_state, result.vertical_state),
            bounced.clearance.tolist(),
            bounced.clearance_deviation.tolist(),
            strict=True,
        )
    )
    return replace(_with_apparent(result, apparent), figures=figures)


def _with_apparent(result: Estimate, apparent: tuple[Interval, ...]) -> Estimate:
    """Return an estimate with new apparent clearances, which hold for a frame of exactly the scene's size.

    The clearances allow for an error of the frame. Their shift and additional width do not change.
    """
    horizontal, vertical = (
        Interval.normal(
            value.mean + new.mean - old.mean,
            math.hypot(new.deviation, math.sqrt(max(value.deviation**2 - old.deviation**2, 0.0))),
        )
        for value, old, new in zip((result.horizontal, result.vertical), result.in_scene_frame(), apparent, strict=True)
    )
    return replace(
        result,
        horizontal=horizontal.above(0.0),
        vertical=vertical.above(0.0),
        apparent=None if result.apparent is None else (apparent[0], apparent[1]),
    )


def _with_differences(
    found: tuple[Problem, Fit], verdict: Verdict, period: float
) -> tuple[tuple[Problem, Fit], Verdict]:
    """Return a fit with differences of walls and sensor if the given fit fails a check or shows such differences.

    If the two pads of a wall differ by 1.2 mm, a fit without differences gives a clearance that is 0.2 mm too small.
    """
    if verdict.sensor and not verdict.by_scale:
        return found, verdict
    least = tuning.MORE_ASKEW * verdict.figures["scale"] if verdict.by_scale else tuning.OUTLYING**2
    if (verdict.by_scale or not _fails(found[1], verdict)) and shown(*found) < least:
        return found, verdict
    again = with_differences(*found)
    other = None if again is None else judge(*again, period)
    if again and other and not _fails(again[1], other):
        return again, other
    return found, verdict


def _moved_back(result: Estimate, bias: Array) -> Estimate:
    x, y, theta = (
        None if known is None else Interval(known.mean + by, known.p05 + by, known.p95 + by)
        for known, by in zip((result.bias_x, result.bias_y, result.bias_theta), bias.tolist(), strict=True)
    )
    motion = None if result.motion is None else result.motion.moved(bias)
    return replace(result, bias_x=x, bias_y=y, bias_theta=theta, motion=motion)


def with_gaps(result: Estimate, by_gaps: GapsFit) -> Estimate:
    """Return an estimate that combines motion and gap sensors; a contradiction withdraws the clearances."""
    found = []
    if by_gaps.contradiction > tuning.OUTLYING:
        found.append(
            f"gaps: one sensor is {by_gaps.contradiction:.1f} times its stated error off the result of all sensors, "
            f"expected at most {tuning.OUTLYING:g} times"
        )
    values, states = [], []
    for name, value, state, mean, deviation in zip(
        ("horizontal", "vertical"),
        (result.horizontal, result.vertical),
        (result.horizontal_state, result.vertical_state),
        by_gaps.clearance.tolist(),
        by_gaps.deviation.tolist(),
        strict=True,
    ):
        moved = value.deviation
        off = _apart((value.mean, moved), (mean, deviation))
        if state.known and off > tuning.OUTLYING:
            found.append(
                f"gaps: {name} {mean:.5f} m by the gaps, {value.mean:.5f} m by the motion, {off:.1f} deviations apart"
            )
        if state.known:
            mean, deviation = _both((mean, deviation), (value.mean, moved))
        withdrawn = state is State.WITHDRAWN
        values.append(value if withdrawn else Interval.normal(mean, deviation).above(0.0))
        states.append(state if withdrawn else State.ESTIMATED)
    if found:
        states = [State.WITHDRAWN] * 2
    state = State.WITHDRAWN if found else State.ESTIMATED
    return replace(
        result,
        horizontal=values[0],
        vertical=values[1],
        horizontal_state=states[0],
        vertical_state=states[1],
        groups=result.groups | {name: (value, state) for name, value in by_gaps.groups.items()},
        sensor="suspect" if found else result.sensor,
        reasons=(*result.reasons, *found),
    )


def summarise_bounced(unknowns: Unknowns, poses: Poses, bounced: Bounced, lost: int, work: int) -> Estimate:
    """Return the estimate for a hard contact. It was found by comparing simulated motions with the measured motion."""
    sensor = judge_sensor(poses)
    found = (
        ("motion", bounced.distance, tuning.MOST_DISTANCE),
        ("path over the load's period", bounced.path, tuning.MOST_PATH),
    )
    model = [
        f"{name} unlike the model's: distance {value:.1f}, expected at most {most:g}"
        for name, value, most in found
        if value > most
    ]
    if bounced.law > MOST_OTHER_LAW and not -math.inf < bounced.odds < tuning.MOST_ODDS[1]:
        model.append(f"motion like that of another contact law: {bounced.law:.1f}, expected at most {MOST_OTHER_LAW:g}")
    if bounced.odds > tuning.MOST_ODDS[0]:
        odds = f"ln odds {bounced.odds:.1f}, expected at most {tuning.MOST_ODDS[0]:g}"
        model.append(f"motion likely under another contact law: {odds}")
    reasons = sensor or model
    beyond = max(1.0, *(value / most for _, value, most in found)) if model else 0.0
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
        if not observed:
            value = _unobserved(unknowns, np.zeros(2), index, 0.0, bounced.noise)
        clearances.append(value.above(0.0))
        states.append(_state(bool(sensor), observed, rough))
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
        stiffness=Interval(float(mean), float(soft), max(float(hard), unknowns.hardest_believed)),
        damping=_damping(unknowns, Interval.normal(*bounced.ln_damping)),
        bias_x=bias[0],
        bias_y=bias[1],
        bias_theta=bias[2],
        noise=(float(bounced.noise[0]), float(bounced.noise[1]), float(bounced.noise[2])),
        model="suspect" if model and not sensor else "ok",
        sensor="suspect" if sensor else "ok",
        reasons=tuple(reasons),
        lost=lost,
        figures={
            "distance": bounced.distance,
            "path": bounced.path,
            "law": bounced.law,
            **({"law_odds": bounced.odds} if math.isfinite(bounced.odds) else {}),
            "work": float(work),
        },
    )


def _both(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Return the weighted mean of two independent measurements, and its standard deviation."""
    weights = one[1] ** -2, other[1] ** -2
    return (one[0] * weights[0] + other[0] * weights[1]) / sum(weights), sum(weights) ** -0.5


def _apart(one: tuple[float, float], other: tuple[float, float]) -> float:
    return abs(one[0] - other[0]) / math.hypot(one[1], other[1])


def _both_of_one(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Return `_both` of two estimates from the same motion, with a larger deviation if they disagree.

    Reference: Birge, Phys. Rev. 40 (1932) 207 (the ratio of external to internal consistency).
    """
    mean, deviation = _both(one, other)
    return mean, deviation * max(1.0, _apart(one, other))


def _state(withdrawn: bool, observed: bool, rough: bool = False) -> State:
    if withdrawn:
        return State.WITHDRAWN
    known = State.ROUGH if rough else State.ESTIMATED
    return known if observed else State.NOT_OBSERVABLE


def _unseen(fit: Fit) -> Array:
    """Return the standard deviation of clearances in m, shape (2,), due to rotations of walls with an untouched pad.

    The motion does not show the position of such a pad, and the linearised fit ignores this uncertainty.
    """
    square = np.zeros(2)
    seconds = fit.point.contact.sum(axis=0)
    for side, pads in _SIDES.items():
        if seconds[list(pads)].min() < tuning.TOUCHED:
            square[GX if side in ("left", "right") else GY] += (0.5 * UNSTATED[f"turn_{side}"]) ** 2
    return np.sqrt(square)


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


def _graded(problem: Problem, fit: Fit, verdict: Verdict) -> Graded | None:
    """Return the result of the fit for a machine that may differ from the model, or None in these cases:

    - The measurements contradict each other.
    - Swings are linked, and either no check fails or the fit has not reached an optimum.
    - The fit has not reached an optimum, and its residuals far exceed the noise.
    """
    if verdict.broken:
        return None
    clean = not _fails(fit, verdict)
    if len(problem.link) and (clean or not fit.finished):
        return None
    found = _if_it_differs(problem, fit, doubtful=not clean)
    if found is None or (not fit.finished and found.inflation.mean() >= tuning.MOST_INFLATED):
        return None
    return found


def _if_it_differs(problem: Problem, fit: Fit, doubtful: bool = True) -> Graded | None:
    try:
        return graded(problem, fit, doubtful)
    except np.linalg.LinAlgError:
        return None


def _next_guess(problem: Problem, fit: Fit) -> Guess:
    return (*fit.shared.tolist(), *fit.noise.tolist(), *problem.differences.tolist())


def thinned(load: Load, period: float) -> tuple[Load, bool]:
    """Return a load without samples that hardly move the head, and whether the load is broad-band.

    A load is broad-band if nearly all its samples move the head. It is then averaged. A load whose samples are too rare
    to show a broad-band part also counts as broad-band.
    """
    load = load.believable()
    most = tuning.KNOTS[0] * max(1.0, float(load.t[-1] - load.t[0]) / period)
    shares = (5e-4, 1e-3, 2e-3, 4e-3, 8e-3)
    significance = load.significance(shares[0])
    thin = load
    for share in shares:
        thin = load.kept(significance > share)
        if len(thin.t) <= most:
            break
    broad = len(thin.t) > most
    felt = load.averaged(tuning.KNOTS[1] * int(most)) if len(thin.t) > tuning.KNOTS[1] * most else thin
    return replace(felt, unknown=load.unknown), broad or load.rare


def warm_up(scene: Scene) -> None:
    """Compile the kernels that a scene needs, or load them from the cache."""
    if scene.head.carries == "corners":
        return
    load = Load.unmeasured(1.0)
    other = with_other_law(Unknowns(scene))
    for one in (scene, *variants(scene), *(() if other is None else (other.scene,))):
        Forward(one, load).run(
            replace(one, loads=(), wear=None),
            np.ones(3),
            np.zeros(1),
            np.zeros((1, 6)),
            np.array([0, 1]),
            np.array([1e-3]),
        )
    row = np.zeros((1, 3))
    lagged(1.0, np.array([0, 1]), np.zeros(1), row, row, row, np.ones(1), row, row)


def summarise(problem: Problem, fit: Fit, verdict: Verdict, lost: int, forces: ContactForces | None = None) -> Estimate:
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
    rough = beside is not None and (suspect or not finished or bool(verdict.lacking))
    deviation = np.sqrt(np.diag(covariance))
    published, spread = shared[[GX, GY]], deviation[[GX, GY]]
    if beside is not None:
        published = np.maximum(beside.clearance, LEAST_CLEARANCE)
        spread = np.hypot(beside.clearance_deviation, _between_optima(problem, shared))
    # a change at an unknown time: its share in the mean over the window is uniformly distributed
    moved = verdict.changed / math.sqrt(3.0)
    deviation[[GX, GY]] = np.hypot(deviation[[GX, GY]], moved)
    spread = np.hypot(np.hypot(spread, moved), _unseen(fit))
    reasons = verdict.model + verdict.sensor + ([verdict.lacking] if verdict.lacking else [])
    if not finished and not suspect:
        gain = f"the cost would still fall by {fit.gain_left:.0f}, expected at most {tuning.OUTLYING**2:g}"
        reasons = [f"the fit has not reached an optimum: {gain}"]
    # the range of motion can exceed the clearance by the penetrations
    given = tuning.GIVEN * float(np.exp(shared[SOFTNESS] + NORMAL_P95 * min(deviation[SOFTNESS], 1.0)))
    least = range_of_motion(unknowns.scene, poses)[0] - given
    share = predicted(fit).sum(axis=0) / np.maximum(np.isfinite(fit.point.residual).sum(axis=0), 1)
    # the equations of motion couple the components: a measured component tests both clearances
    share = np.where(poses.measured, share, share[poses.measured].min())
    apparent, clearances, states = [], [], []
    untested: dict[int, Interval] = {}
    for index, sides in ((GX, ("left", "right")), (GY, ("top", "bottom"))):
        # only a predicted motion tests a clearance; hard contacts are exempt, because their bounces are unpredictable
        tested = share[index] > tuning.PREDICTED or unknowns.penetration_of(float(shared[SOFTNESS])) < tuning.HARD
        if not tested and finished and not suspect:
            reasons.append(
                f"{'horizontal' if index == GX else 'vertical'} clearance not observable: {share[index]:.0%} of "
                f"{COMPONENTS[index]} is predicted, expected {tuning.PREDICTED:.0%} or more"
            )
        touched = min(float(fit.point.contact[:, _SIDES[side]].sum()) for side in sides)
        observed = tested and touched > tuning.TOUCHED and shared[index] > LEAST_CLEARANCE
        observed &= deviation[index] < (2.0 * tuning.OBSERVED if rough else tuning.OBSERVED) and (finished or rough)
        apparent.append(Interval.normal(shared[index], deviation[index]))
        value = Interval.normal(published[index], spread[index])
        if not observed:
            value = _unobserved(unknowns, deviation, index, least[index], fit.noise)
        clearances.append(value.above(0.0))
        states.append(_state(suspect and not rough, observed, rough))
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
        model="suspect" if verdict.model or verdict.lacking else "ok",
        sensor="suspect" if verdict.sensor else "ok",
        reasons=tuple(reasons),
        lost=lost,
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
        return replace(
            result,
            horizontal_state=State.WITHDRAWN,
            vertical_state=State.WITHDRAWN,
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
    states = result.horizontal_state, result.vertical_state
    apparent = tuple(
        new if state is State.ESTIMATED else old
        for state, old, new in zip(states, result.in_scene_frame(), (normal[GX], normal[GY]), strict=True)
    )
    return replace(
        _with_apparent(result, apparent),
        **_numbers(problem.unknowns, normal),
        correlation=_correlation(covariance),
    )


def _numbers(unknowns: Unknowns, normal: list[Interval]) -> dict[str, Any]:
    values = {quantity.name: value for quantity, value in zip(QUANTITIES, normal, strict=True)}
    del values["horizontal"], values["vertical"]
    contact = {
        "stiffness": _stiffness(unknowns, normal[SOFTNESS]),
        "damping": _damping(unknowns, normal[DAMPING]),
    }
    return values | contact


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

    The ratio of observed to expected variance is averaged over all unknowns that move the head, because the ratio of a
    single unknown would be too random. The colour multiplies the deviation, because coloured residuals stay correlated
    for long.
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
    scattered = np.diag(sandwich(problem, fit, 1.0 / problem.deviation**2))
    swings, moving = problem.window.swings, list(MOVING)
    return freed(swings, len(moving)) * float((scattered / variance)[moving].mean())


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

    Parameters
    ----------
    problem, fit : Problem, Fit
        The fit.
    widened : float
        Factor on the standard deviations of the fit.
    states : list of State
        States of the horizontal and the vertical clearance.
    untested : dict
        Clearances that no predicted motion tests, by the index of the axis. They replace the clearances between pads.
    shared, added : ndarray
        The unknowns of a machine that may differ from the model, and their covariance minus that of the fit.
    """
    out = {}
    for name, (value, deviation) in by_group(problem, fit, widened).items():
        axis = GX if name.startswith("horizontal") else GY
        state = states[axis]
        whole = math.sqrt(deviation**2 + max(float(added[axis, axis]), 0.0))
        if state.known and whole > 0.5 * tuning.OBSERVED:
            state = State.NOT_OBSERVABLE
        found = Interval.normal(value.mean + float(shared[axis] - fit.shared[axis]), whole).above(0.0)
        out[name] = untested.get(axis, found), state
    return out


def _correlation(covariance: Array) -> tuple[tuple[float, ...], ...]:
    moving = covariance[np.ix_(MOVING, MOVING)]
    deviation = np.sqrt(np.diag(moving))
    matrix = moving / np.outer(deviation, deviation)
    return tuple(tuple(row) for row in matrix.tolist())


def _unobserved(unknowns: Unknowns, deviation: Array, index: int, reach: float, noise: Array) -> Interval:
    """Return the interval of a clearance that is not observed: the prior above the range of motion `reach`."""
    nominal, spread = unknowns.nominal()[index], max(unknowns.deviations()[index], deviation[index])
    return Interval.normal(nominal, spread).above(reach - 3.0 * float(np.hypot(noise[index], 1e-4)))


def _stiffness(unknowns: Unknowns, psi: Interval) -> Interval:
    """Return the stiffness from the softness `psi`.

    The interval extends to `Unknowns.hardest_believed` if it includes contacts that are too hard to be resolved.
    """
    soft, hard = unknowns.stiffness_of(psi.p95), unknowns.stiffness_of(psi.p05)
    if unknowns.within(np.full(SIZE, psi.p05))[SOFTNESS] > psi.p05:
        hard = max(hard, unknowns.hardest_believed)
    return Interval(unknowns.stiffness_of(psi.mean), soft, hard)


def _damping(unknowns: Unknowns, value: Interval) -> Interval | None:
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


def prior_of(unknowns: Unknowns, span: tuple[float, float], lost: int) -> Estimate:
    """Return the prior as an estimate."""
    nominal, spread = unknowns.nominal(), unknowns.deviations()
    horizontal, vertical = (Interval.normal(nominal[i], spread[i]).above(0.0) for i in (GX, GY))
    psi = Interval.normal(nominal[SOFTNESS], spread[SOFTNESS])
    return Estimate(
        *span, horizontal, vertical, State.PRIOR, State.PRIOR, stiffness=_stiffness(unknowns, psi), lost=lost
    )


def _lacking(poses: Poses) -> tuple[str, ...]:
    """Return messages about components that were hardly measured, or about poses that are too rare."""
    useless = tuple(
        f"{name}: stated deviation {deviation:g}, expected at most {most:g}"
        for name, deviation, most in zip(COMPONENTS, poses.deviation, useless_deviation(), strict=True)
        if deviation > most
    )
    if useless:
        return useless
    counts = np.isfinite(poses.q).sum(axis=0).tolist()
    lacking = tuple(
        f"{name}: measured {count} times, expected at least {FEWEST_POSES}"
        for name, count in zip(COMPONENTS, counts, strict=True)
        if count < FEWEST_POSES
    )
    if lacking:
        return lacking
    # a flight within a gap is not measured
    apart = max(poses.interval(), poses.gap())
    if apart > tuning.SPARSEST:
        lacking = (f"poses: got {1.0 / apart:.1f} a second, expected at least {1.0 / tuning.SPARSEST:.1f}",)
    return lacking


def _well_measured(poses: Poses) -> Poses | None:
    """Return the poses without components that were hardly measured.

    The result is None if all or no components were measured well, or if the remaining poses are too rare.
    """
    counts = np.isfinite(poses.q).sum(axis=0)
    well = (np.array(poses.deviation) <= useless_deviation()) & (counts >= FEWEST_POSES)
    if well.all() or not well.any():
        return None
    q = np.where(well, poses.q, np.nan)
    rows = np.isfinite(q).any(axis=1)
    some = replace(poses, t=poses.t[rows], q=q[rows])
    return some if max(float(np.median(np.diff(some.t))), some.gap()) <= tuning.SPARSEST else None


def _is_dead(load: Load, poses: Poses) -> bool:
    """Return whether the measured load is constant although the head moves, which shows a failed load sensor."""
    late = filled(poses)[len(poses.t) // 2 :, poses.measured]
    return load.constant and bool((late.std(axis=0) > tuning.OUTLYING * noise_level(late)).any())


def _is_idle(scene: Scene, load: Load, poses: Poses) -> bool:
    weight = scene.head.mass_kg * Gravity().acceleration_m_s2
    most = tuning.IDLE_LOAD * weight * np.array([1.0, 1.0, geometry.half_diagonal(scene)])
    return bool((load.wrench.std(axis=0) < most).all()) and _rests(poses)


def _rests(poses: Poses) -> bool:
    q = filled(poses)[len(poses.t) // 4 :, poses.measured]
    return bool((q.std(axis=0) < tuning.RESTS * noise_level(q)).all())


def _not_observable(unknowns: Unknowns, poses: Poses, lost: int, reasons: tuple[str, ...]) -> Estimate:
    nothing, unseen = prior_of(unknowns, (float(poses.t[0]), float(poses.t[-1])), lost), State.NOT_OBSERVABLE
    return replace(nothing, horizontal_state=unseen, vertical_state=unseen, reasons=reasons)


def _without_fit(
    unknowns: Unknowns, poses: Poses, lost: int, why: str = "no motion of the model comes near the measured one"
) -> Estimate:
    return replace(
        prior_of(unknowns, (float(poses.t[0]), float(poses.t[-1])), lost),
        horizontal_state=State.WITHDRAWN,
        vertical_state=State.WITHDRAWN,
        model="suspect",
        reasons=(why,),
    )
