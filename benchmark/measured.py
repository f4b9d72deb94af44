"""Comparison of the contact model with measured impacts of an ellipse and drops of a square.

    python benchmark/measured.py                 compute all: benchmark/results/measured.json
    python benchmark/measured.py --only square   compute the drops of the square only
    python benchmark/measured.py --only fit      fit the square to each half of its drops; errors on the other half
    python benchmark/measured.py --only table    estimate the height of the table from each drop
    python benchmark/measured.py --plot          draw the stored results to docs/images

Parameters are fitted to each half of the data in `benchmark/data/measured`. Errors are computed on the other half.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rigid_square import rigid_toss, two_at_once
from scipy.optimize import minimize

from plow_twin import Initial, simulate
from plow_twin.estimate import tuning
from plow_twin.estimate.block import impacts
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import State
from plow_twin.estimate.start import noise_level
from plow_twin.model.contact_laws import LAWS
from plow_twin.scene_file import load_scene
from plow_twin.solve.rounded_block import toss_blocks
from plow_twin.study.measured.drops import Drops
from plow_twin.study.measured.ellipse import ELLIPSE, GYRATION, EllipseContact, contact_arms, impact, simulated_impact
from plow_twin.study.measured.square import (
    MARKER,
    RATE_HZ,
    SCATTER,
    SQUARE,
    Marker,
    damping_numbers,
    ensemble,
    fit_flight,
    toss,
)

FOLDER = Path(__file__).resolve().parent
DATA = FOLDER / "data" / "measured"
RESULTS = FOLDER / "results" / "measured.json"
IMAGES = FOLDER.parent / "docs" / "images"
#: First step of each unknown in a fit.
STEPS = {"tilt": 0.004, "fall": 0.1, "fall_along": 0.05, "slip_speed": 0.05, "restitution": 0.05, "friction": 0.03}
PLAIN = replace(ELLIPSE, fall=0.0, fall_along=0.0, tilt=0.0, restitution=0.54)
FRICTIONS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "regularised": (dict(slip_speed=0.05), ("slip_speed",)),
    "spring": (dict(stick_stiffness=4.0, stick_damping=0.0), ("stick_stiffness",)),
    "spring and damper": (dict(stick_stiffness=1.6, stick_damping=0.16), ("stick_stiffness", "stick_damping")),
}
FALLING = ("fall", "fall_along", "tilt")


class Impacts:
    """The measured impacts of the ellipse, divided into two halves."""

    def __init__(self) -> None:
        with np.load(DATA / "ellipse_impacts.npz") as data:
            self.before, self.after = data["before"], data["after"]
        self.half = np.random.default_rng(1).permutation(len(self.before)) % 2

    def missed(self, predicted: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return the norm of the velocity error [m/s]. Angular velocities are multiplied by the radius of gyration."""
        return np.asarray(np.linalg.norm((predicted - self.after[chosen])[:, 3:] * [1.0, 1.0, GYRATION], axis=1))

    def fit(self, start: EllipseContact, names: tuple[str, ...], chosen: np.ndarray) -> EllipseContact:
        """Fit the named parameters to the chosen impacts. The fit minimises the root mean square of the errors."""
        first = np.array([getattr(start, name) for name in names])
        steps = [STEPS.get(name, 0.2 * getattr(start, name) + 0.02) for name in names]

        def contact(values: np.ndarray) -> EllipseContact:
            numbers: dict[str, Any] = {name: float(value) for name, value in zip(names, values, strict=True)}
            return replace(start, **numbers)

        def cost(values: np.ndarray) -> float:
            contact_found = contact(values)
            if (
                min(
                    contact_found.restitution,
                    contact_found.friction,
                    contact_found.slip_speed,
                    contact_found.stick_stiffness,
                )
                < 0.0
            ):
                return 9.0
            return float((self.missed(impact(self.before[chosen], contact_found), chosen) ** 2).mean())

        simplex = np.vstack([first, first + np.diag(steps)])
        options = dict(maxfev=20 * len(names), initial_simplex=simplex, xatol=1e-3, fatol=1e-6)
        return contact(minimize(cost, first, method="Nelder-Mead", options=options).x)

    def held_out(self, start: EllipseContact, names: tuple[str, ...]) -> dict[str, Any]:
        """Fit the named parameters to each half of the impacts. Return the errors on the other half."""
        missed, fitted = [], []
        for half in (0, 1):
            contact = self.fit(start, names, np.flatnonzero(self.half != half))
            chosen = np.flatnonzero(self.half == half)
            missed.append(self.missed(impact(self.before[chosen], contact), chosen))
            fitted.append({name: round(float(getattr(contact, name)), 4) for name in names})
        return {**errors(np.concatenate(missed)), "fitted": fitted}

    def rigid(self, model: Any) -> dict[str, Any]:
        """Fit e and mu of a rigid impact to each half of the impacts. Return the errors on the other half."""
        missed = []
        for half in (0, 1):
            fit, held = np.flatnonzero(self.half != half), np.flatnonzero(self.half == half)

            def cost(x: np.ndarray, chosen: np.ndarray = fit) -> float:
                return float((self.missed(rigid_impact(self.before[chosen], model, *x), chosen) ** 2).mean())

            simplex = np.array([[0.54, 0.18], [0.6, 0.18], [0.54, 0.22]])
            optimum = minimize(
                cost, simplex[0], method="Nelder-Mead", options=dict(initial_simplex=simplex, maxfev=40)
            ).x
            missed.append(self.missed(rigid_impact(self.before[held], model, *optimum), held))
        return errors(np.concatenate(missed))

    def floor(self) -> dict[str, Any]:
        """Return the error of the best possible impulse at the lowest point, a lower bound for all contact laws."""
        arm, up = contact_arms(self.before[:, 2])
        change = (self.after - self.before)[:, 3:] * [-1.0, 1.0, GYRATION]
        rows = np.zeros((len(change), 3, 2))
        rows[:, 0, 0] = rows[:, 1, 1] = 1.0
        rows[:, 2, 0], rows[:, 2, 1] = -up / GYRATION, arm / GYRATION
        impulse = np.einsum("nij,nj->ni", np.linalg.pinv(rows), change)
        return errors(np.linalg.norm(np.einsum("nij,nj->ni", rows, impulse) - change, axis=1))


def errors(missed: np.ndarray) -> dict[str, Any]:
    return {"rms": round(float(np.sqrt((missed**2).mean())), 4), "median": round(float(np.median(missed)), 4)}


def rigid_impact(before: np.ndarray, model: Any, e: float, mu: float) -> np.ndarray:
    """Return the states after rigid impacts at the lowest point; `model` returns the impulses (p_t, p_n)."""
    arm, up = contact_arms(before[:, 2])
    inertia, after = GYRATION**2, before.copy()
    slip, rate = -before[:, 3] - before[:, 5] * up, before[:, 4] + before[:, 5] * arm
    mobility = 1.0 + up**2 / inertia, 1.0 + arm**2 / inertia, -arm * up / inertia
    along, away = model(slip, rate, *mobility, e, abs(mu))
    after[:, 3] -= along
    after[:, 4] += away
    after[:, 5] += (arm * away - up * along) / inertia
    return after


def routh(slip, rate, tt, nn, tn, e, mu, bit=2e-3, energetic=False):  # type: ignore[no-untyped-def]
    """Return impulses by Routh's method: Coulomb friction acts on each increment of the normal impulse.

    The impact ends by Poisson's restitution, a ratio of impulses, or with `energetic` by Stronge's restitution, a ratio
    of works of the normal force.

    References
    ----------
    Routh (1860), Dynamics of a system of rigid bodies. Wang, Mason (1992), J. Appl. Mech. 59, 635. Mirtich (1996),
    thesis, Berkeley.
    """
    along, away, end = np.zeros_like(slip), np.zeros_like(slip), np.full_like(slip, np.inf)
    work, least = np.zeros_like(slip), np.zeros_like(slip)
    for _ in range(round(8.0 / bit)):
        now = slip + tt * along + tn * away
        drag = np.clip(-(now + tn * bit) / tt, -mu * bit, mu * bit)
        going = work < (1.0 - e**2) * least - 1e-12 if energetic else away < end
        going |= np.isinf(end)
        before = rate + nn * away + tn * along
        along, away = along + np.where(going, drag, 0.0), away + np.where(going, bit, 0.0)
        after = rate + nn * away + tn * along
        work += np.where(going, 0.5 * bit * (before + after), 0.0)
        turned = (after >= 0.0) & np.isinf(end)
        least = np.where(turned, work, least)
        end = np.where(turned, (1.0 + e) * away, end)
        if not going.any():
            break
    return along, away


def mirtich(slip, rate, tt, nn, tn, e, mu):  # type: ignore[no-untyped-def]
    return routh(slip, rate, tt, nn, tn, e, mu, energetic=True)  # type: ignore[no-untyped-call]


def drumwright_shell(slip, rate, tt, nn, tn, e, mu):  # type: ignore[no-untyped-def]
    """Return the impulses in the friction cone with the least remaining kinetic energy, and Poisson's restitution.

    References
    ----------
    Drumwright, Shell (2010), Algorithmic Foundations of Robotics IX, 249.
    """
    determinant = tt * nn - tn**2
    away, along = (tn * slip - tt * rate) / determinant, (tn * rate - nn * slip) / determinant
    slides = np.abs(along) > mu * away
    side = np.sign(along)
    # on the edge of the friction cone, (side mu, 1), the impulse is the larger of two: the impulse with the least
    # remaining energy, and the impulse that stops the approach
    least = -(side * mu * slip + rate) / (tt * mu**2 + 2.0 * side * mu * tn + nn)
    stopped = -rate / (nn + tn * mu * side)
    away = np.where(slides, np.maximum(least, stopped), away)
    return np.where(slides, mu * side * away, along), (1.0 + e) * away


def anitescu_potra_newton(slip, rate, tt, nn, tn, e, mu):  # type: ignore[no-untyped-def]
    """Return the impulses of `newton` without restitution, multiplied by 1 + e."""
    along, away = newton(slip, rate, tt, nn, tn, 0.0, mu)  # type: ignore[no-untyped-call]
    return (1.0 + e) * along, (1.0 + e) * away


def newton(slip, rate, tt, nn, tn, e, mu):  # type: ignore[no-untyped-def]
    """Return impulses that stop the slip or lie on the friction cone, with Newton's restitution (Whittaker, 1904)."""
    change_of_rate = -(1.0 + e) * rate
    determinant = tt * nn - tn**2
    away, along = (tt * change_of_rate + tn * slip) / determinant, (-nn * slip - tn * change_of_rate) / determinant
    slides = np.abs(along) > mu * away
    side = np.sign(along)
    limited = change_of_rate / (nn + tn * mu * side)
    return np.where(slides, mu * side * limited, along), np.where(slides, limited, away)


def anitescu_potra(slip, rate, tt, nn, tn, e, mu):  # type: ignore[no-untyped-def]
    """Return the impulses of a complementarity problem, with Poisson's restitution of the normal impulse.

    References
    ----------
    Anitescu, Potra (1997), Nonlinear Dyn. 14, 231.
    """
    along, away = newton(slip, rate, tt, nn, tn, 0.0, mu)  # type: ignore[no-untyped-call]
    return along, (1.0 + e) * away


RIGID = {
    "Routh, Poisson": routh,
    "Mirtich, Stronge": mirtich,
    "Whittaker, Newton": newton,
    "Anitescu-Potra, Poisson": anitescu_potra,
    "Anitescu-Potra, Newton": anitescu_potra_newton,
    "Drumwright-Shell, Poisson": drumwright_shell,
}


def by_law(impacts: Impacts) -> dict[str, Any]:
    found: dict[str, Any] = {"any impulse at the point": impacts.floor()}
    for name, model in RIGID.items():
        found[f"rigid: {name}"] = impacts.rigid(model)
        print(name, found[f"rigid: {name}"], flush=True)
    for law, about in LAWS.items():
        start = 0.25 if about.additive else 0.8 if about.number_of is None else 0.54
        for friction, (numbers, names) in FRICTIONS.items():
            contact = replace(PLAIN, law=law, exponent=about.exponent or 1.0, restitution=start, **numbers)
            name = f"{law}, {friction}"
            found[name] = impacts.held_out(contact, ("restitution", "friction", *names))
            print(name, found[name], flush=True)
    for friction, (numbers, names) in FRICTIONS.items():
        name = f"falling restitution, {friction}"
        contact = replace(ELLIPSE, **numbers)
        found[name] = impacts.held_out(contact, ("restitution", "friction", *names, *FALLING))
        print(name, found[name], flush=True)
    every = np.arange(len(impacts.before))
    found["preset `measured_ellipse`, fitted to all, computed whole"] = errors(
        impacts.missed(simulated_impact(impacts.before), every)
    )
    return found


def crps(members: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the continuous ranked probability score of an ensemble, shape (m, ...), at each row."""
    count = len(members)
    weights = (2 * np.arange(1, count + 1) - count - 1).reshape(-1, *[1] * measured.ndim)
    return np.asarray(
        np.abs(members - measured).mean(axis=0) - (weights * np.sort(members, axis=0)).sum(axis=0) / count**2
    )


def sharp() -> np.ndarray:
    """Return a square with sharp corners, constant restitution and constant friction, fitted like the preset."""
    block = SQUARE.copy()
    for name, value in dict(
        half=0.03, radius=0.0, gyration=0.06 / 6**0.5, table=-5e-4, restitution=0.4362, restitution_fall=0.0,
        friction=0.1014, friction_fall=0.0, tangential=1.0, tangential_damping=0.3,
    ).items():  # fmt: skip
        block[name] = value
    return block


def without_drag() -> np.ndarray:
    """Return a block with the outline of the preset `measured_square`, constant friction and no drag."""
    frame, block = load_scene("measured_square").frame, SQUARE.copy()
    block["radius"] = frame.corner_radius_m
    block["half"] = 0.5 * frame.width_m - float(block["radius"])
    for name in ("table", "friction_fall", "drag", "spin_drag"):
        block[name] = 0.0
    return block


#: Parameters of the block that are fitted together with the marker.
FITTED = (
    "half", "radius", "gyration", "table", "restitution", "restitution_fall", "friction", "friction_fall", "mass_power",
    "tangential", "tangential_damping", "drag", "spin_drag",
)  # fmt: skip


#: Fitted parameters of the preset `measured_square`.
PRESET_FITTED = (
    "gyration", "stiffness", "restitution", "restitution_fall", "mass_power", "friction", "tangential",
    "tangential_damping", "gravity",
)  # fmt: skip
#: Largest differences between two first flights that are treated as equal: angle [rad], and rates [m/s, m/s, rad/s].
NEAR_TWINS = (0.05, 0.15, 0.15, 1.5)
#: Largest time [s] between the touches of two corners that are treated as simultaneous.
TWO_AT_ONCE_S = 1e-3


class Square:
    """The measured drops, and simulated drops of a block with a marker."""

    def __init__(self, drops: Drops) -> None:
        self.drops, self.usable = drops, np.array(drops.usable())
        self.first = drops.flight_rows[self.usable] - 1
        bounces = [drops.bounces[i] for i in self.usable]
        #: Number of rows from the end of the first flight to each of the next three bounces, shape (n, 3); 0 if there
        #: is no such bounce.
        self.rows = np.array(
            [
                [its[k] - first if k < len(its) else 0 for k in (1, 2, 3)]
                for its, first in zip(bounces, self.first, strict=True)
            ]
        )
        self.flights = np.array([fit_flight(drops.pose[i, : drops.flight_rows[i]]).state for i in self.usable])

    def errors(self, block: np.ndarray, marker: Marker, chosen: np.ndarray, bounces: int) -> np.ndarray:
        """Return the mean distance [m] and angle [rad], shape (k, 2), of the drops with at least `bounces` bounces."""
        enough = chosen[self.rows[chosen, bounces - 1] > 0]
        states = marker.state_of_block(self.flights[enough])
        tossed = toss(states, self.rows[enough, bounces - 1].max() + 1, np.full(len(enough), block, block.dtype))
        return self.off(marker.measured(tossed[:, :, :3]), enough, bounces)

    def off(self, poses: Iterable[np.ndarray], chosen: np.ndarray, bounces: int) -> np.ndarray:
        """Return the mean distance [m] and angle [rad], shape (k, 2), of poses (k, rows, 3) from the chosen drops."""
        errors = []
        for n, motion in zip(chosen, poses, strict=True):
            rows, first = self.rows[n, bounces - 1], self.first[n]
            off = motion[:rows] - self.drops.pose[self.usable[n], first : first + rows]
            errors.append((np.hypot(off[:, 0], off[:, 1]).mean(), np.abs(off[:, 2]).mean()))
        return np.array(errors)

    def against_rigid(self) -> dict[str, Any]:
        """Return the errors of rigid and of compliant impacts over one bounce.

        The errors are those of all drops, of drops with two corners that touch simultaneously, and of all other drops.
        e and mu of the rigid impacts are fitted to all drops.
        """
        every = np.flatnonzero(self.rows[:, 0] > 0)
        states, rows = MARKER.state_of_block(self.flights[every]), int(self.rows[every, 0].max()) + 1

        def rigid(x: np.ndarray) -> np.ndarray:
            return self.off(MARKER.measured(rigid_toss(states, rows, SQUARE, routh, *x)[:, :, :3]), every, 1)[:, 0]

        def cost(x: np.ndarray) -> float:
            distance = rigid(np.clip(x, 0.0, 1.0))
            return float((distance / (1.0 + distance / 0.02)).mean())

        simplex = np.array([[0.5, 0.12], [0.4, 0.12], [0.5, 0.18]])
        fitted = minimize(cost, simplex[0], method="Nelder-Mead", options=dict(initial_simplex=simplex, maxfev=30)).x
        fine = np.zeros((len(every), 16 * rows, 6))
        fine[:, 0] = states
        blocks = np.full(len(every), SQUARE, SQUARE.dtype)
        toss_blocks(blocks, damping_numbers(), np.zeros((len(every), 1, 3)), 1.0 / (16.0 * RATE_HZ), fine)
        twice = two_at_once(fine, 16 * self.rows[every, 0], SQUARE, TWO_AT_ONCE_S)
        found: dict[str, Any] = {"e, mu": np.round(fitted, 3).tolist(), "two_at_once": int(twice.sum())}
        for name, distance in (("rigid", rigid(fitted)), ("compliant", self.errors(SQUARE, MARKER, every, 1)[:, 0])):
            medians = (float(np.median(distance[which])) for which in (slice(None), twice, ~twice))
            found[name] = [round(1e3 * median, 1) for median in medians]
        return found

    def fit(
        self, chosen: np.ndarray, start: np.ndarray, names: tuple[str, ...], rounds: int = 3
    ) -> tuple[np.ndarray, Marker]:
        """Fit block and marker to the chosen drops."""

        def numbers(x: np.ndarray) -> tuple[np.ndarray, Marker]:
            block = start.copy()
            for name, value in zip(names, x[3:], strict=True):
                block[name] = value
            return block, Marker(float(x[0]), (float(x[1]), float(x[2])))

        def cost(x: np.ndarray) -> float:
            block, marker = numbers(x)
            if min(block[name] for name in names if name != "table") <= 0.0:
                return 9.0
            (one, angle), (two, _) = (self.errors(block, marker, chosen, bounces).T for bounces in (1, 2))
            distance = sum(share * (d / (1.0 + d / 0.02)).mean() for share, d in ((1.0, one), (0.3, two)))
            return float(1e3 * distance + 0.3 * np.minimum(angle, 1.0).mean())

        # the first values of the marker follow from the angles and heights at rest
        x = np.array([-0.0335, 3.4e-4, 5.2e-4, *(float(start[name]) for name in names)])
        step = np.array([0.005, 3e-4, 3e-4, *(0.12 * abs(float(start[name])) + 1e-4 for name in names)])
        for turn in range(rounds):
            options = dict(maxfev=900, adaptive=True, initial_simplex=np.vstack([x, x + np.diag(step / (1 + turn))]))
            x = minimize(cost, x, method="Nelder-Mead", options=options).x
        return numbers(x)

    def of_preset(self) -> dict[str, Any]:
        """Return the errors of the preset `measured_square` over one, two and three bounces."""
        scene, far = load_scene("measured_square"), []
        for bounces in (1, 2, 3):
            chosen, poses = np.flatnonzero(self.rows[:, bounces - 1] > 0), []
            for n in chosen:
                x, z, theta, *rates = MARKER.state_of_block(self.flights[n])
                begun = replace(scene, initial=Initial((x, z - 1.0, theta), (rates[0], rates[1], rates[2])))
                motion = simulate(begun, t_end=self.rows[n, bounces - 1] / RATE_HZ, output_dt=1.0 / RATE_HZ)
                poses.append(MARKER.measured(motion.q + np.array([0.0, 1.0, 0.0])))
            far.append(self.off(poses, chosen, bounces))
        return medians(far)

    def near_twins(self) -> dict[str, Any]:
        """Return the distance over one bounce between pairs of measured drops with nearly equal first flights.

        The drops are compared from the time at which the centre is 50 mm above the table. Differences in x and whole
        quarter turns are subtracted.
        """
        gravity, height = float(SQUARE["gravity"]), 0.05
        # time from the last row of the flight until the centre is 50 mm above the table
        z, fall = self.flights[:, 1], self.flights[:, 4]
        shift = (fall + np.sqrt(np.maximum(fall**2 + 2.0 * gravity * (z - height), 0.0))) / gravity
        turned = self.flights[:, 2] + shift * self.flights[:, 5]
        speed = fall - gravity * shift
        state = np.stack([turned % (0.5 * np.pi), self.flights[:, 3], speed, self.flights[:, 5]], axis=1)
        motions = []
        for n, index in enumerate(self.usable):
            pose, at = self.drops.pose[index], self.first[n] + RATE_HZ * shift[n] + np.arange(self.rows[n, 0])
            motions.append(np.stack([np.interp(at, np.arange(len(pose)), pose[:, j]) for j in (0, 1)], axis=1))
        apart = []
        for i, j in combinations(np.flatnonzero(self.rows[:, 0] > 0), 2):
            if (np.abs(state[i] - state[j]) < NEAR_TWINS).all():
                rows = int(min(self.rows[[i, j], 0]))
                one, other = (motions[n][:rows] - [motions[n][0, 0], 0.0] for n in (i, j))
                apart.append(float(np.hypot(*(one - other).T).mean()))
        return {"pairs": len(apart), "distance_mm": round(1e3 * float(np.median(apart)), 1)}

    def held_out(self, start: np.ndarray = SQUARE, names: tuple[str, ...] = FITTED) -> dict[str, Any]:
        """Fit block and marker to each half of the drops. Return the errors on the other half, by number of bounces."""
        half = np.random.default_rng(1).permutation(len(self.usable)) % 2
        far: list[list[np.ndarray]] = [[], [], []]
        fitted = []
        for half_left_out in (0, 1):
            block, marker = self.fit(np.flatnonzero(half != half_left_out), start, names)
            for bounces in (1, 2, 3):
                far[bounces - 1].append(self.errors(block, marker, np.flatnonzero(half == half_left_out), bounces))
            numbers = {name: round(float(block[name]), 6) for name in names}
            fitted.append({**numbers, "turn": round(marker.turn, 4), "lever": np.round(marker.lever, 6).tolist()})
        return {**medians([np.concatenate(part) for part in far]), "fitted": fitted}


def medians(far: list[np.ndarray]) -> dict[str, Any]:
    """Return the medians of distances [m] and angles [rad], shape (n, 2) each, over one, two and three bounces."""
    return {
        "drops": [len(distances) for distances in far],
        "distance_mm": [round(1e3 * float(np.median(distances[:, 0])), 1) for distances in far],
        "angle_rad": [round(float(np.median(distances[:, 1])), 2) for distances in far],
    }


def of_drops(drops: Drops) -> dict[str, Any]:
    """Return the distances of both blocks over one, two and three bounces, and coverage and score of the bands."""
    results: dict[str, Any] = {}
    kinds = {
        "rounded corners, falling restitution and friction, marker": (SQUARE, MARKER),
        "sharp corners, constant restitution and friction": (sharp(), Marker()),
    }
    square = Square(drops)
    every = np.arange(len(square.usable))
    for name, (block, marker) in kinds.items():
        inside: list[list[np.ndarray]] = [[], []]
        scores = []
        for index in square.usable:
            pose, flight_rows, lows = drops.pose[index], int(drops.flight_rows[index]), drops.bounces[index]
            until = drops.until(index, 2) + 1
            members = ensemble(
                pose[:flight_rows], until, members=200, seed=index, block=block, scatter=SCATTER, marker=marker
            )
            low, high = np.quantile(members, [0.05, 0.95], axis=0)
            holds = (pose[:until] >= low) & (pose[:until] <= high)
            scores.append(crps(members[:, flight_rows:], pose[flight_rows:until]).mean(axis=0))
            for bounce, (first, last) in enumerate(pairwise([flight_rows - 1, *lows[1:3]])):
                inside[bounce].append(holds[first:last].mean(axis=0))
        results[name] = {
            **medians([square.errors(block, marker, every, bounces) for bounces in (1, 2, 3)]),
            "coverage": [np.round(np.mean(rows, axis=0), 3).tolist() for rows in inside if rows],
            "crps_mm_mm_rad": np.round(np.mean(scores, axis=0) * [1e3, 1e3, 1.0], 2).tolist(),
            "crps_median": np.round(np.median(scores, axis=0) * [1e3, 1e3, 1.0], 2).tolist(),
        }
        print(name, results[name], flush=True)
    return results


def of_table(drops: Drops) -> dict[str, Any]:
    square, rng = load_scene("measured_square"), np.random.default_rng(1)
    marks = dict(square.marks)
    marks["clearance.vertical_m"] = replace(marks["clearance.vertical_m"], deviation=0.01)
    true, t = square.clearance.vertical_m, np.arange(drops.pose.shape[1]) / RATE_HZ
    nothing = Load.unmeasured(t[-1], t[0])
    heights = []
    for pose in drops.pose:
        clearance = replace(square.clearance, vertical_m=true + 0.01 * rng.standard_normal())
        result = estimate(replace(square, clearance=clearance, marks=marks), nothing, Poses(t, pose - [0.0, 1.0, 0.0]))
        if result.vertical_state.known:
            rough = result.vertical_state is State.ROUGH
            heights.append((result.vertical.mean, result.vertical.p05, result.vertical.p95, rough))
    mean, low, high, rough = np.array(heights).T
    off = 0.5 * np.abs(mean - true)
    return {
        "drops": len(drops.pose),
        "estimated": len(heights),
        "median_mm": round(1e3 * float(np.median(off)), 2),
        "rms_mm": round(1e3 * float(np.sqrt((off**2).mean())), 2),
        "within_half_mm": round(float((off < 5e-4).mean()), 2),
        "rough": round(float(rough.mean()), 2),
        "within_half_mm_or_rough": round(float(((off < 5e-4) | (rough > 0.0)).mean()), 2),
        "coverage": round(float(((low < true) & (true < high)).mean()), 2),
        "half_width_mm": round(0.25e3 * float(np.median(high - low)), 2),
    }


def of_heights(drops: Drops) -> dict[str, Any]:
    """Return the spread of the table's height between drops, from the heights at rest and at impacts."""
    square, t = load_scene("measured_square"), np.arange(drops.pose.shape[1]) / RATE_HZ
    nothing = Load.unmeasured(t[-1], t[0])
    places, rests, hits = [], [], []
    for pose in drops.pose:
        motion = MARKER.state_of_block(np.concatenate([pose, np.zeros_like(pose)], axis=1))[:, :3] - [0.0, 1.0, 0.0]
        end = motion[-12:]
        impacts_found, _ = impacts(square, nothing, Poses(t, motion), noise_level(motion))
        below = [
            impact.deeper - impact.distance
            for impact in impacts_found
            if impact.wall == "bottom" and impact.gained < tuning.GAINED
        ]
        if len(below) and np.ptp(end[:, 1]) < 1e-3 and np.ptp(end[:, 2]) < 5e-3 and end[:, 1].mean() < -0.967:
            places.append(end[:, 0].mean())
            rests.append(end[:, 1].mean())
            hits.append(np.median(below))
    slope = np.polyfit(places, rests, 1)[0]
    return {
        "drops": len(rests),
        "rest_deviation_mm": round(1e3 * float(np.std(rests)), 2),
        "impact_deviation_mm": round(1e3 * float(np.std(hits)), 2),
        "correlation": round(float(np.corrcoef(rests, hits)[0, 1]), 2),
        "slope_mm_per_m": round(1e3 * float(slope), 1),
    }


def plot(results: dict[str, Any], drops: Drops) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(8, 0.24 * len(results["ellipse"]) + 1))
    names = sorted(results["ellipse"], key=lambda name: -results["ellipse"][name]["rms"])
    axis.barh(names, [results["ellipse"][name]["rms"] for name in names], color="tab:blue", label="RMS")
    axis.plot([results["ellipse"][name]["median"] for name in names], names, "k|", label="median")
    axis.set_xlabel("error of the velocity after the impact, held out [m/s]")
    axis.set_title("Measured impacts of an ellipse, by contact law")
    axis.margins(y=0.01)
    axis.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    figure.savefig(IMAGES / "measured_laws.png", dpi=110, bbox_inches="tight")
    index = next(i for i in drops.usable() if len(drops.bounces[i]) > 2)
    pose, flight_rows = drops.pose[index], int(drops.flight_rows[index])
    rows = drops.until(index, 2) + 1
    points = np.quantile(ensemble(pose[:flight_rows], rows), [0.05, 0.5, 0.95], axis=0)
    figure, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True)
    t = np.arange(rows) / 250.0
    units = (("x [mm]", 1e3), ("z [mm]", 1e3), ("angle [degrees]", float(np.degrees(1.0))))
    for j, (axis, (name, unit)) in enumerate(zip(axes, units, strict=True)):
        axis.fill_between(
            t, unit * points[0, :, j], unit * points[2, :, j], color="tab:blue", alpha=0.3, label="90 % band"
        )
        axis.plot(t, unit * points[1, :, j], color="tab:blue", label="median")
        axis.plot(t, unit * pose[:rows, j], "k.", markersize=3, label="measured")
        axis.axvline((flight_rows - 1) / 250.0, color="0.6", label="end of the first flight")
        axis.set_ylabel(name)
    axes[0].set_title(f"Measured drop {index} of a square, predicted from its first flight")
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    axes[2].set_xlabel("time [s]")
    figure.savefig(IMAGES / "measured_drop.png", dpi=110, bbox_inches="tight")
    figure, axis = plt.subplots(figsize=(6, 3.4))
    for name, figures_of_law in results["square"].items():
        rounded = name.startswith("rounded")
        block = "rounded corners, e falls" if rounded else "sharp corners, e constant"
        for j, (component, style) in enumerate((("x", "-"), ("z", "--"), ("angle", ":"))):
            color = "tab:blue" if rounded else "tab:orange"
            cover = [100.0 * row[j] for row in figures_of_law["coverage"]]
            axis.plot(range(1, len(cover) + 1), cover, style, marker="o", color=color, label=f"{component}, {block}")
    axis.axhspan(85.0, 95.0, color="0.9", label="aim")
    axis.set_xticks([1, 2])
    axis.set_xlabel("after bounce")
    axis.set_ylabel("rows inside the 90 % band [%]")
    axis.set_title("Measured drops of a square")
    axis.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=8)
    figure.savefig(IMAGES / "measured_coverage.png", dpi=110, bbox_inches="tight")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plot", action="store_true", help="draw the stored results")
    parser.add_argument(
        "--only", choices=("square", "ellipse", "fit", "table"), help="compute only this part of the results"
    )
    chosen = parser.parse_args()
    drops = Drops.load(DATA / "square_drops.npz")
    results = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    if chosen.plot:
        plot(results, drops)
        return
    if chosen.only in (None, "square"):
        results["square"] = of_drops(drops)
        square = Square(drops)
        results["square_rigid"] = square.against_rigid()
        results["square_preset"] = square.of_preset()
        results["square_near_twins"] = square.near_twins()
        print({name: results[name] for name in results if name.startswith("square_")}, flush=True)
    if chosen.only in (None, "fit"):
        results["square_held_out"] = Square(drops).held_out()
        results["square_preset_held_out"] = Square(drops).held_out(without_drag(), PRESET_FITTED)
        print(results["square_held_out"], results["square_preset_held_out"], flush=True)
    if chosen.only in (None, "table"):
        results["table"], results["heights"] = of_table(drops), of_heights(drops)
        print(results["table"], results["heights"], flush=True)
    if chosen.only in (None, "ellipse"):
        results["ellipse"] = by_law(Impacts())
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
