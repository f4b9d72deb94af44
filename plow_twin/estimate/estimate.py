"""Estimate of clearances, contact, load gains and sensor errors from one window of measurements."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.block import estimate_block
from plow_twin.estimate.bouncing import Bounced, bias_of_hard, bounces, by_range, compare
from plow_twin.estimate.combined import deviations_apart, weighted_mean, weighted_mean_of_one, with_bounced, with_gaps
from plow_twin.estimate.discrepancy import variants
from plow_twin.estimate.fit import Fit, Problem
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.gaps import Gaps, GapsFit, fit_gaps
from plow_twin.estimate.lacking import with_harmonics
from plow_twin.estimate.measurements import FEWEST_POSES, Load, Poses, filled
from plow_twin.estimate.orientation import misfits_of_axes
from plow_twin.estimate.pads import shown, with_differences
from plow_twin.estimate.reason import LENGTH, TIME, Reason
from plow_twin.estimate.relinearised import with_other_law_numbers
from plow_twin.estimate.result import Estimate, ForcesUsed, Interval, State
from plow_twin.estimate.screening import is_dead, is_idle, rests, shortages, thinned, well_measured
from plow_twin.estimate.search import LOW_PASS, behind_low_pass, candidate, refine
from plow_twin.estimate.similar import Units
from plow_twin.estimate.start import noise_level
from plow_twin.estimate.summary import (
    contradictory,
    damping_interval,
    fails,
    if_it_differs,
    not_observable,
    prior_of,
    state_of,
    summarise,
    summarise_bounced,
    unobserved_because,
    without_fit,
    without_unobserved,
)
from plow_twin.estimate.uncertain_load import compare_under_uncertain_load
from plow_twin.estimate.unknowns import BIAS, DAMPING, GX, GY, SIZE, SOFTNESS, Unknowns, with_other_law
from plow_twin.estimate.unmeasured import fit_some_components
from plow_twin.estimate.verdict import Verdict, judge
from plow_twin.kernel.low_pass import lagged
from plow_twin.model.scene import Scene
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


def estimate(
    scene: Scene, load: Load, poses: Poses, lost: int = 0, gaps: Gaps | None = None, forces: ContactForces | None = None
) -> Estimate:
    """Return the estimate of clearances, contact, load gains, and the sensor's bias and delay from a window.

    Parameters
    ----------
    scene : Scene
        The nominal scene. Its gravity is assumed to be exact. All other numbers are the means of their priors.
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
        found = estimate_block(scene, load, poses, prior_of(Unknowns.stated(scene, load, poses), span))
        return replace(found, lost=lost), ()
    units = Units.of(scene, load.longest_stretch())
    if units == Units():
        return _estimate(scene, load, poses, lost, guess, gaps, forces)
    measurements = units.load(load), units.poses(poses)
    found, following = _estimate(units.scene(scene), *measurements, lost, guess, units.gaps(gaps), units.forces(forces))
    found = units.in_si(found, scene)
    if units.only_time and found.sensor == "ok" and found.horizontal_state is not State.PRIOR:
        # the duration of an impact does not depend on the load's period, so repeat with times in s
        load, poses, _ = _usable(load, poses)
        period = _period(load, poses)
        unknowns = Unknowns.stated(scene, load, poses)
        found = under_uncertain_load(found, unknowns, thinned(load, period)[0], poses, period)
    return found, following


def _estimate(
    scene: Scene, load: Load, poses: Poses, lost: int, guess: Guess, gaps: Gaps | None, forces: ContactForces | None
) -> tuple[Estimate, Guess]:
    """Return the result of `estimate_window`, with all numbers in the units of the arguments."""
    load, poses, unusable = _usable(load, poses)
    span = float(load.t[0]), float(load.t[-1])
    by_gaps = None if gaps is None else fit_gaps(scene, gaps.between(span[0], span[1] + 1e-9), poses)
    if isinstance(by_gaps, GapsFit) and len(by_gaps.poses.t) and (len(poses.t) < FEWEST_POSES or shortages(poses)):
        poses = by_gaps.poses
    if forces is not None:
        forces = forces.between(span[0], span[1] + 1e-9)
    try:
        result, following = _from_motion(scene, load, poses, guess, forces)
        if _unexplained(result) and load.interval() > tuning.COARSEST:
            smooth = load.smooth(0.1 * tuning.COARSEST)
            other, following = _from_motion(scene, smooth, poses, (), forces)
            reason = Reason(
                "load: a sample every {:.2g} s, expected {:g} s; taken as averages",
                (load.interval(), TIME),
                (tuning.COARSEST, TIME),
            )
            result = replace(other, reasons=(reason, *other.reasons)) if _known(other) else result
    except (np.linalg.LinAlgError, OverflowError) as error:
        result, following = without_fit(Unknowns(scene), poses, f"the fit cannot be computed: {error}"), ()
    if forces is not None and result.forces_measured is None:
        result = replace(result, forces_measured=ForcesUsed(unused="the motion is not known moment by moment"))
    if isinstance(by_gaps, GapsFit):
        result = with_gaps(result, by_gaps)
    elif by_gaps is not None:
        result = replace(result, reasons=(*result.reasons, by_gaps))
    return replace(result, lost=lost + unusable), following


def _usable(load: Load, poses: Poses) -> tuple[Load, Poses, int]:
    """Return the newest window of the longest stretch of the load, its poses without spikes, and the rows left out."""
    samples, measured, lost = len(load.t), len(poses.t), 0
    load = load.longest_stretch()
    span = float(load.t[0]), float(load.t[-1])
    poses = poses.between(span[0], span[1] + 1e-9)
    if len(load.t) < samples:
        lost = samples - len(load.t) + measured - len(poses.t)
    load = load.newest(_LONGEST_S)
    load = load.newest(max(MOST_PERIODS * (load.oscillation() or 0.0), MOST_SPAN_S))
    poses = poses.between(float(load.t[0]), span[1] + 1e-9).fresh()
    poses, spikes = poses.without_spikes(noise_level(filled(poses)))
    return load, poses, lost + spikes


def _known(result: Estimate) -> bool:
    return any(state.known for state in result.states)


def _unexplained(result: Estimate) -> bool:
    # averages taken for samples can resemble a shift of the sensor
    return "suspect" in (result.model, result.sensor) and not _known(result)


def _from_motion(
    scene: Scene, load: Load, poses: Poses, guess: Guess, forces: ContactForces | None
) -> tuple[Estimate, Guess]:
    span = float(load.t[0]), float(load.t[-1])
    unknowns = Unknowns.stated(scene, load, poses)
    if len(poses.t) < FEWEST_POSES:
        few = Reason(
            f"got {len(poses.t)} poses within the load's span, {{:g}} s to {{:g}} s, expected at least "
            f"{FEWEST_POSES}: model and sensor are not checked",
            (span[0], TIME),
            (span[1], TIME),
        )
        return replace(prior_of(unknowns, span), reasons=(few,)), ()
    short_of = shortages(poses)
    some = well_measured(poses)
    if some is not None and not is_dead(load, some):
        return _from_some_components(unknowns, load, some, short_of), ()
    if short_of:
        return not_observable(unknowns, poses, short_of), ()
    if is_dead(load, poses):
        return _without_load(unknowns, load, poses), ()
    if is_idle(scene, load, poses):
        return not_observable(unknowns, poses, ("the head rests under a load that hardly changes",)), ()
    if rests(poses):
        return without_fit(
            unknowns, poses, "the head rests under a load that changes: the head or its sensor is stuck"
        ), ()
    period = _period(load, poses)
    measured_load, broad = thinned(load, period)
    drift = tuning.LEFT_OPEN * np.array(measured_load.unknown) / np.asarray(inertias(scene)) ** 2 if broad else None
    forward = Forward(scene, measured_load)
    if guess:
        numbers = np.array(guess)
        shared, noise, differences = np.split(numbers, [SIZE, SIZE + 3])
        # the guess for a contact harder than `FITTED` is not from a fit
        certain = unknowns.penetration_of(float(shared[SOFTNESS])) > tuning.FITTED
        near = refine(forward, unknowns, poses, period, unknowns.within(shared), noise, drift, differences, certain)
        verdict = judge(*near, period) if near else None
        if near and verdict and not fails(near[1], verdict):
            near, verdict = _with_differences(near, verdict, period)
            return summarise(*near, verdict, forces), _next_guess(*near)
        forward = Forward(scene, measured_load)
    bias = bias_of_hard(unknowns, poses)
    wrong = misfits_of_axes(forward.renewed(), unknowns, poses.moved(-bias))
    if wrong:
        return contradictory(unknowns, poses, tuple(wrong)), ()
    result, following = _searched(forward, unknowns, poses.moved(-bias), period, drift, forces)
    if following:
        numbers = np.array(following)
        numbers[BIAS] += bias
        following = tuple(numbers.tolist())
    return _moved_back(result, bias), following


def _without_load(unknowns: Unknowns, load: Load, poses: Poses) -> Estimate:
    """Return the estimate from the poses alone, without a measured load.

    The range of motion is the clearance plus the penetrations at two opposite walls, which are estimated from the
    equations of motion for walls that yield.
    """
    reason = "the same value throughout, while the head moves"
    if load.missing:
        reason = "not measured (no load.csv, or no sample), expected the load that moves the head"
    nothing = without_fit(unknowns, poses, f"load: {reason}")
    bias = bias_of_hard(unknowns, poses)
    poses = poses.moved(-bias)
    if bounces(unknowns, poses):
        found = summarise_bounced(unknowns, poses, by_range(unknowns, poses), 0)
        return replace(_moved_back(found, bias), model="suspect", reasons=(*nothing.reasons, *found.reasons))
    return under_uncertain_load(nothing, unknowns, None, poses, float(poses.t[-1] - poses.t[0]) / 10.0)


def _from_some_components(unknowns: Unknowns, load: Load, poses: Poses, short_of: tuple[str, ...]) -> Estimate:
    """Return the estimate from poses in which one or two components were never measured."""
    period = _period(load, poses)
    measured_load, _ = thinned(load, period)
    forward = Forward(unknowns.scene, measured_load)
    wrong = misfits_of_axes(forward.renewed(), unknowns, poses)
    if wrong:
        return contradictory(unknowns, poses, (*short_of, *wrong))
    share, time = tuning.UNMEASURED_LOAD
    drift = 2.0 * time * (share * load.wrench.std(axis=0) / np.asarray(inertias(unknowns.scene))) ** 2
    found = fit_some_components(forward, unknowns, poses, period, drift)
    if found is not None:
        result = summarise(*found, judge(*found, period))
        if _known(result):
            return replace(result, reasons=(*short_of, *result.reasons))
    if poses.measured[:2].all():
        nothing = replace(prior_of(unknowns, (float(poses.t[0]), float(poses.t[-1]))), reasons=short_of)
        return under_uncertain_load(nothing, unknowns, measured_load, poses, period)
    return not_observable(unknowns, poses, short_of)


def _searched(
    forward: Forward,
    unknowns: Unknowns,
    poses: Poses,
    period: float,
    drift: Array | None,
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
        return summarise_bounced(unknowns, poses, bounced, forward.work, first), ()
    if first is None:
        return under_uncertain_load(without_fit(unknowns, poses), unknowns, forward.load, poses, period), ()
    start = first.shared if bounced is None else _from_bounced(unknowns, first.shared, bounced)
    spent, forward = forward.work, forward.renewed() if bounced else forward
    found = refine(forward, unknowns, poses, period, start, first.noise, drift, close=bounced is not None)
    if bounced is not None and (found is None or not found[1].finished):
        return summarise_bounced(unknowns, poses, bounced, spent + forward.work, first), ()
    if found is None:
        return under_uncertain_load(without_fit(unknowns, poses), unknowns, forward.load, poses, period), ()
    if bounced is None:
        found = _nearer_the_prior(found, forward, unknowns, poses, period, first.noise, drift)
    verdict, plain = judge(*found, period), found
    behind = behind_low_pass(*searched) if searched and fails(found[1], verdict) and not verdict.broken else None
    if behind is not None:
        refined = refine(forward.renewed(), unknowns, poses, period, behind.shared, behind.noise, drift, LOW_PASS)
        if refined and refined[1].loss < found[1].loss:
            found, verdict = refined, judge(*refined, period)
    found, verdict = _with_differences(found, verdict, period)
    if bounced is None and fails(found[1], verdict) and (verdict.by_scale or not verdict.sensor):
        # friction can resemble wrong scales of the sensor
        found, verdict = with_other_law_numbers(*found, period) or (found, verdict)
    if bounced is None and fails(found[1], verdict) and not verdict.sensor:
        # a low pass of the sensor or a change of the machine can resemble harmonics
        found, verdict = with_harmonics(*plain, forward.load, period) or (found, verdict)
    result = summarise(*found, verdict, forces if bounced is None else None)
    if bounced is None and fails(found[1], verdict) and not verdict.broken:
        result = under_uncertain_load(result, unknowns, forward.load, poses, period, found)
    following = () if verdict.model or verdict.sensor or verdict.added else _next_guess(*found)
    return result if bounced is None else with_bounced(result, bounced, spent), following


def _nearer_the_prior(
    found: tuple[Problem, Fit],
    forward: Forward,
    unknowns: Unknowns,
    poses: Poses,
    period: float,
    noise: Array,
    drift: Array | None,
) -> tuple[Problem, Fit]:
    """Return a fit from a starting point with prior clearances, if it is better than a fit far from the prior.

    The search compares few clearances that are far from the prior. If a wall is never touched, a fit may explain the
    noise of the poses by touches of a wall that is far too near.
    """
    nominal, deviations = unknowns.nominal(), unknowns.deviations()
    far = [axis for axis in (GX, GY) if abs(found[1].shared[axis] - nominal[axis]) > tuning.FAR * deviations[axis]]
    if not far:
        return found
    start = found[1].shared.copy()
    start[far], start[BIAS] = nominal[far], nominal[BIAS]
    other = refine(forward.renewed(), unknowns, poses, period, start, noise, drift)
    return other if other is not None and other[1].loss < found[1].loss else found


def _period(load: Load, poses: Poses) -> float:
    return min(load.period(), float(poses.t[-1] - poses.t[0]))


def under_uncertain_load(
    result: Estimate,
    unknowns: Unknowns,
    measured_load: Load | None,
    poses: Poses,
    period: float,
    fitted: tuple[Problem, Fit] | None = None,
) -> Estimate:
    """Replace the withdrawn clearances of the estimate `result` by values that allow for errors of the load.

    The values come from a comparison with motions under uncertain loads. `fitted` is a fit that failed a check. Its
    clearances are combined with those of the comparison where they agree.
    """
    if _known(result) or (measured_load is not None and measured_load.interval() > tuning.COARSEST):
        return result
    compared, work = compare_under_uncertain_load(measured_load, unknowns, poses, period)
    figures = result.figures | {"work": result.figures.get("work", 0.0) + float(work)}
    if compared is None or compared.distance > tuning.MOST_DISTANCE or compared.ln_depth[0] < math.log(tuning.FITTED):
        return replace(result, figures=figures)
    beside = None if fitted is None else if_it_differs(*fitted)
    # the reasons of the fit do not hold for the values of the comparison
    values, states, reasons = [], [], without_unobserved(result.reasons)
    for index in (GX, GY):
        prior = float(unknowns.nominal()[index]), float(unknowns.deviations()[index])
        mean, deviation = weighted_mean((float(compared.clearance[index]), float(compared.deviation[index])), prior)
        if beside is not None:
            by_fit = float(beside.shared[index]), math.sqrt(beside.covariance[index, index])
            if deviations_apart((mean, deviation), by_fit) < tuning.AGREES:
                mean, deviation = weighted_mean_of_one((mean, deviation), by_fit)
        most, touched = tuning.OBSERVED_SHARE * prior[1], bool(compared.touched[index])
        observed = touched and deviation < most
        if not observed:
            wide = Reason(
                "deviation of {:.2g} m under an uncertain load, expected less than {:.2g} m",
                (deviation, LENGTH),
                (most, LENGTH),
            )
            reasons.append(unobserved_because(index, wide if touched else Reason("a wall is hardly touched")))
        values.append(Interval.normal(*((mean, deviation) if observed else prior)).above(0.0))
        states.append(state_of(False, observed, rough=True))
    exponent = unknowns.scene.contact.exponent
    log = Interval.normal(*compared.ln_depth)
    mean, soft, hard = (unknowns.force / math.exp(value) ** exponent for value in (log.mean, log.p95, log.p05))
    return result.having(
        values,
        states,
        stiffness=Interval(mean, soft, hard),
        damping=damping_interval(unknowns, Interval.normal(*compared.ln_damping)),
        correlation=None,
        groups={},
        reasons=tuple(reasons),
        figures=figures | {"distance": compared.distance, "load_error": compared.load_error},
    )


def _from_bounced(unknowns: Unknowns, shared: Array, bounced: Bounced) -> Array:
    start = shared.copy()
    start[[GX, GY]], start[DAMPING] = bounced.clearance, bounced.ln_damping[0]
    penetration = math.exp(bounced.ln_penetration[0])
    start[SOFTNESS] = unknowns.softness_of(unknowns.force / penetration**unknowns.scene.contact.exponent)
    return unknowns.within(start)


def _with_differences(
    found: tuple[Problem, Fit], verdict: Verdict, period: float
) -> tuple[tuple[Problem, Fit], Verdict]:
    """Return a fit with differences of walls and sensor if the given fit fails a check or shows such differences.

    If the two pads of a wall differ by 1.2 mm, a fit without differences gives a clearance that is 0.2 mm too small.
    """
    if verdict.sensor and not verdict.by_scale:
        return found, verdict
    least = tuning.MORE_ASKEW * verdict.figures["scale"] if verdict.by_scale else tuning.OUTLYING**2
    if (verdict.by_scale or not fails(found[1], verdict)) and shown(*found) < least:
        return found, verdict
    fitted = with_differences(*found)
    other = None if fitted is None else judge(*fitted, period)
    if fitted and other and not fails(fitted[1], other):
        return fitted, other
    return found, verdict


def _moved_back(result: Estimate, bias: Array) -> Estimate:
    x, y, theta = (
        interval and Interval(interval.mean + by, interval.p05 + by, interval.p95 + by)
        for interval, by in zip((result.bias_x, result.bias_y, result.bias_theta), bias.tolist(), strict=True)
    )
    return replace(result, bias_x=x, bias_y=y, bias_theta=theta, motion=result.motion and result.motion.moved(bias))


def _next_guess(problem: Problem, fit: Fit) -> Guess:
    return (*fit.shared.tolist(), *fit.noise.tolist(), *problem.differences.tolist())


def warm_up(scene: Scene) -> None:
    """Compile the kernels that a scene needs, or load them from the cache."""
    if scene.head.carries == "corners":
        return
    load = Load.unmeasured(1.0)
    other = with_other_law(Unknowns(scene))
    for variant in (scene, *variants(scene), *(() if other is None else (other.scene,))):
        bare, edges, times = replace(variant, loads=(), wear=None), np.array([0, 1]), np.array([1e-3])
        Forward(variant, load).run(bare, np.ones(3), np.zeros(1), np.zeros((1, 6)), edges, times)
    row = np.zeros((1, 3))
    lagged(1.0, np.array([0, 1]), np.zeros(1), row, row, row, np.ones(1), row, row)
