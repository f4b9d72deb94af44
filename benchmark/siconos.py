"""A slider with clearance in its guide, compared with the reference data of Siconos.

The slider is that of Flores, Leine and Glocker, Multibody Syst. Dyn. 23 (2010) 165, table 1. Siconos computes it with
rigid contact and time stepping. The reference data are not part of this project. They are in
github.com/siconos/siconos-tutorials, examples/mechanics/SliderCrank/*.ref (Apache-2.0, INRIA). `python
benchmark/siconos.py FOLDER` compares the `.ref` files in a copy of that folder, and writes
`benchmark/results/siconos.csv`.

Both models have four corners in a guide. The slider of Siconos is driven by a crank and a rod. Our slider is a free
body, on which the mechanism acts as a load m a(t), where a(t) is the acceleration across the guide without contact, in
the state of the reference at time t.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from plow_twin import Clearance, Contact, Frame, Gravity, Head, Initial, Result, Scene, Table, simulate

Array = NDArray[np.float64]

TABLE = Path(__file__).resolve().parent / "results" / "siconos.csv"
# lengths of crank and rod, half length and half height of the slider, and clearance on each side [m]
CRANK, ROD, HALF_LENGTH, HALF_HEIGHT, GAP = 0.153, 0.306, 0.05, 0.025, 0.001
MASSES = (0.038, 0.038, 0.076)  # kg
INERTIAS = (7.4e-5, 5.9e-4, 2.7e-6)  # kg m^2
GRAVITY, RESTITUTION = 9.81, 0.4
#: Angular velocities of crank and rod at the start [rad/s]. All angles are 0.
START = (150.0, -75.0)
PAIRS = ("top_left_top", "top_right_top", "bottom_right_bottom", "bottom_left_bottom")
#: Columns of the reference: time, revolutions of the crank, angle of the rod, rates, height divided by clearance, and
#: four impulses.
_TIME, _TURNS, _ROD, _RATES, _HEIGHT, _IMPULSES = 0, 1, 2, slice(4, 6), 12, slice(21, 25)


def gaps(y: Array, theta: Array) -> Array:
    """Return the gap functions g1 .. g4 of the source [m], shape (n, 4)."""
    s, c = HALF_LENGTH * np.sin(theta), HALF_HEIGHT * np.cos(theta)
    half = HALF_HEIGHT + GAP
    return np.stack([half - (y - s + c), half - (y + s + c), half + (y - s - c), half + (y + s - c)], axis=-1)


def inertia_and_force(angles: Array, rates: Array) -> tuple[Array, Array]:
    """Return the mass matrix (2, 2) and generalised forces (2,) of crank and rod, for a slider that does not turn."""
    first, second = angles
    (m1, m2, m3), (j1, j2, _) = MASSES, INERTIAS
    coupling = (0.5 * m2 + m3) * CRANK * ROD
    mixed = coupling * math.cos(second - first)
    mass = [[j1 + (0.25 * m1 + m2 + m3) * CRANK**2, mixed], [mixed, j2 + (0.25 * m2 + m3) * ROD**2]]
    turning = coupling * math.sin(first - second)
    force = [
        -turning * rates[1] ** 2 - (0.5 * m1 + m2 + m3) * GRAVITY * CRANK * math.cos(first),
        turning * rates[0] ** 2 - (0.5 * m2 + m3) * GRAVITY * ROD * math.cos(second),
    ]
    return np.array(mass), np.array(force)


def across(angles: Array) -> Array:
    """Return the derivatives of the slider's height with respect to the angles, shape (2,)."""
    return np.array([CRANK * math.cos(angles[0]), ROD * math.cos(angles[1])])


def free_acceleration(angles: Array, rates: Array) -> tuple[float, float]:
    """Return the acceleration [m/s^2] across the guide without contact, and the effective mass [kg] in a contact."""
    mass, force = inertia_and_force(angles, rates)
    row = across(angles)
    bent = CRANK * math.sin(angles[0]) * rates[0] ** 2 + ROD * math.sin(angles[1]) * rates[1] ** 2
    free = row @ np.linalg.solve(mass, force) - bent
    return float(free), float(1.0 / (row @ np.linalg.solve(mass, row)))


def rigid_motion(t_end: float, impacts: int) -> tuple[Array, Array, list[float]]:
    """Integrate the mechanism with rigid, frictionless impacts, located by event detection.

    Return times (n,), states (n, 4) of angles and rates, and the times of the first impacts.
    """

    def rate(_: float, state: Array) -> Array:
        mass, force = inertia_and_force(state[:2], state[2:])
        return np.concatenate([state[2:], np.linalg.solve(mass, force)])

    def height(_: float, state: Array) -> float:
        return GAP - abs(CRANK * math.sin(state[0]) + ROD * math.sin(state[1]))

    height.terminal, height.direction = True, -1.0  # type: ignore[attr-defined]
    time, state = 0.0, np.array([0.0, 0.0, *START])
    times: list[float] = [0.0]
    states: list[Array] = [state]
    impact_times: list[float] = []
    while time < t_end and len(impact_times) <= impacts:
        part = solve_ivp(rate, (time, t_end), state, "DOP853", events=height, rtol=1e-12, atol=1e-14, max_step=1e-5)
        times += part.t[1:].tolist()
        states += list(part.y.T[1:])
        time, state = float(part.t[-1]), part.y[:, -1].copy()
        if part.status == 1:
            impact_times.append(time)
            mass, _ = inertia_and_force(state[:2], state[2:])
            row = across(state[:2])
            weight = np.linalg.solve(mass, row)
            state[2:] -= weight * (1.0 + RESTITUTION) * (row @ state[2:]) / (row @ weight)
            # the rates jump, so the state after the impact is a second row
            times.append(math.nextafter(time, math.inf))
            states.append(state)
    return np.array(times), np.array(states), impact_times


def our_slider(t: Array, angles: Array, rates: Array, stiffness: float, output_dt: float) -> Result:
    """Simulate our head in the guide under the load of the mechanism at `angles` and `rates`, shape (n, 2) each.

    Our head is a cavity that moves about a fixed block, so its height is minus the height of the slider.
    """
    free = np.array([free_acceleration(q, v)[0] for q, v in zip(angles, rates, strict=True)])
    wrench = np.stack([np.zeros_like(free), -free, np.zeros_like(free)], axis=1)
    speed = -float(across(angles[0]) @ rates[0])
    scene = Scene(
        Head(1.0, 1.0), Frame(2.0 * HALF_LENGTH, 2.0 * HALF_HEIGHT), Clearance(1.0, 2.0 * GAP),
        Contact("exact_restitution", stiffness, restitution=RESTITUTION), Gravity(0.0),
        (Table("mechanism", t, wrench),), Initial((0.0, 0.0, 0.0), (0.0, speed, 0.0)), ("x", "theta"), PAIRS,
    )  # fmt: skip
    return simulate(scene, float(t[-1]), output_dt=output_dt, tol=1e-9)


@dataclass(frozen=True)
class Comparison:
    """A quantity of a reference, computed by Siconos (`theirs`) and by our solver (`ours`)."""

    reference: str
    quantity: str
    theirs: float
    ours: float
    unit: str


def phases(touching: NDArray[np.bool_], t: Array) -> list[tuple[float, float]]:
    """Return the start and the end of each rest, which is an uninterrupted contact of at least 1 ms."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], touching.astype(int), [0]]))).reshape(-1, 2)
    whole = [(float(t[first]), float(t[last - 1])) for first, last in edges.tolist()]
    return [(begin, end) for begin, end in whole if end - begin >= 1e-3]


def compare(name: str, data: Array) -> list[Comparison]:
    t, angles, rates = data[:, _TIME], np.c_[2.0 * np.pi * data[:, _TURNS], data[:, _ROD]], data[:, _RATES]
    ours = our_slider(t, angles, rates, 1e9, 1e-4)
    theirs = GAP * data[:, _HEIGHT]
    touching: NDArray[np.bool_] = np.any(data[:, _IMPULSES] > 0.0, axis=1)
    touched: NDArray[np.bool_] = np.any(ours.force > 0.0, axis=1)
    first = float(ours.events["time"][0])
    rows = [
        Comparison(
            name, "largest gap function error", 0.0, float(abs(gaps(theirs, data[:, 3]) - data[:, 13:17]).max()), "m"
        ),
        Comparison(name, "first touch", float(t[np.argmax(touching)]), first, "s"),
    ]
    for index, (rest, own) in enumerate(zip(phases(touching, t)[:3], phases(touched, t)[:3], strict=False)):
        rows.append(Comparison(name, f"rest {index + 1} ends", rest[1], own[1], "s"))
    window = (t > 0.0125) & (t < 0.0145)
    mass = np.array([free_acceleration(q, v)[1] for q, v in zip(angles, rates, strict=True)])
    impulse = float((ours.force.sum(axis=1) * mass)[window].sum() * 1e-4)
    rows.append(Comparison(name, "impulse 12.5 .. 14.5 ms", float(data[window, _IMPULSES].sum()), impulse, "N s"))
    for until in (0.01, 0.02, 0.04, 0.2):
        apart = float(abs(-ours.q[: len(t), 1] - theirs)[t <= until].max() / GAP)
        rows.append(Comparison(name, f"largest difference of height to {until:g} s", 0.0, apart, "clearance"))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a copy of siconos-tutorials/examples/mechanics/SliderCrank")
    files = sorted(path for path in parser.parse_args().folder.glob("*.ref") if path.stat().st_size)
    data = {path.stem.removeprefix("SliderCrank"): np.loadtxt(path, skiprows=1) for path in files}
    rows = [row for name, table in data.items() for row in compare(name, table)]
    names = list(data)
    for one, other in itertools.pairwise(names):
        for until in (0.01, 0.02, 0.04, 0.2):
            near = data[one][:, _TIME] <= until
            apart = float(abs(data[one][near, _HEIGHT] - data[other][near, _HEIGHT]).max())
            label = f"largest difference of height to {until:g} s"
            rows.append(Comparison(f"{one} against {other}", label, 0.0, apart, "clearance"))
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["reference", "quantity", "theirs", "ours", "unit"])
        writer.writerows([r.reference, r.quantity, f"{r.theirs:.6g}", f"{r.ours:.6g}", r.unit] for r in rows)
    print(TABLE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
