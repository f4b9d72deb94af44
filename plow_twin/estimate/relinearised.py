"""Fits with the friction and the exponent that a linearised step has found.

The motion is far from linear in friction and exponent: a step from a scene without friction finds half of the true
coefficient, and other quantities take up the rest. Therefore, steps from the scene that was found alternate with fits
(Gauss-Newton).
"""

from __future__ import annotations

from dataclasses import replace

from plow_twin.estimate import tuning
from plow_twin.estimate.discrepancy import CREEP, EXPONENT, FRICTION, Graded, least_change, moved_scene
from plow_twin.estimate.fit import Fit, Problem, fit
from plow_twin.estimate.reason import NUMBER, SPEED, Reason
from plow_twin.estimate.summary import if_it_differs
from plow_twin.estimate.unknowns import SOFTNESS, Unknowns
from plow_twin.estimate.verdict import Verdict, judge
from plow_twin.model.scene import Friction, Scene

#: Upper bounds on the number of fits, and on the number of iterations in each fit.
_ROUNDS, _ITERATIONS = 6, 20


def with_other_law_numbers(problem: Problem, fitted: Fit, period: float) -> tuple[tuple[Problem, Fit], Verdict] | None:
    """Return a fit with another friction or exponent than the scene has, and its verdict.

    The result is None if no such fit is clearly better, or if swings are linked. `period` is that of the load in s.
    """
    if len(problem.link):
        return None
    first, forward = problem.unknowns, problem.forward
    for _ in range(_ROUNDS):
        beside = if_it_differs(problem, fitted)
        changes = {} if beside is None else _considerable(beside, problem.unknowns.changes)
        if beside is None or not changes:
            break
        unknowns = _changed(first, changes, first.penetration_of(float(fitted.shared[SOFTNESS])))
        other = problem.having(forward=forward.of(unknowns.scene), unknowns=unknowns)
        refitted = fit(other, unknowns.within(beside.shared), fitted.point.states, fitted.noise, _ITERATIONS)
        if refitted is None or refitted.loss > fitted.loss - tuning.OUTLYING**2:
            break
        problem, fitted = other, refitted
    if problem.unknowns.nominal_scene is None:
        return None
    verdict = judge(problem, fitted, period)
    verdict.added = _named(problem.unknowns)
    return (problem, fitted), verdict


def _considerable(beside: Graded, changes: dict[str, float]) -> dict[str, float]:
    """Return the differences for the next fit; empty if those in the present fit, `changes`, hardly change.

    At most one difference is added, because others may only make up for its linearised step.
    """
    by = {path: beside.differs[path][1] for path in (EXPONENT, FRICTION, CREEP) if path in beside.differs}
    steps = {path: abs(by[path] - changes.get(path, 0.0)) / beside.differs[path][2] for path in by}
    new = {path for path in by if path not in changes and beside.differs[path][0] > tuning.CERTAIN}
    chosen = {*changes, *sorted(new, key=lambda path: steps[path])[-1:]}
    if not chosen <= set(by) or all(steps[path] < tuning.OUTLYING for path in chosen):
        return {}
    return {path: by[path] for path in by if path in chosen}


def _changed(unknowns: Unknowns, changes: dict[str, float], depth: float) -> Unknowns:
    """Return the prior about the scene with the differences `changes`; `depth` is that of `moved_scene`."""
    scene = nominal = unknowns.scene
    changes = {path: max(by, least_change(nominal, path)) for path, by in changes.items()}
    for path, by in changes.items():
        scene = moved_scene(scene, path, by, depth)
    return replace(unknowns, scene=scene, nominal_scene=nominal, changes=changes)


def _named(unknowns: Unknowns) -> Reason:
    """Return a text with the numbers of the nominal and of the changed scene."""
    forms, numbers = [], []
    for path in unknowns.changes:
        forms.append(f"{path}: {{:.3g}} explains the motion, the scene has {{:.3g}}")
        dimension = SPEED if path == CREEP else NUMBER
        numbers += [(_value(scene, path), dimension) for scene in (unknowns.scene, unknowns.nominal_scene)]
    return Reason(", ".join(forms), *numbers)


def _value(scene: Scene | None, path: str) -> float:
    part, name = path.split(".")
    return float(getattr(getattr(scene, part) or Friction(0.0), name))
