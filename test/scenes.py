"""Scenes that several tests use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from plow_twin import Clearance, Contact, Frame, Friction, Gravity, Harmonic, Head, Initial, Scene
from plow_twin.model.geometry import penetration_rows
from plow_twin.scene_file import load_scene

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(__file__).resolve().parent / "data"


def preset(name: str) -> Scene:
    return load_scene(ROOT / "config" / f"{name}.yaml")


def reference(name: str) -> dict[str, np.ndarray]:
    with np.load(DATA / f"{name}.npz") as archive:
        return {key: archive[key] for key in archive.files}


def pose_error(scene: Scene, q: np.ndarray, reference_q: np.ndarray) -> float:
    """Return the largest pose error relative to the clearance. Angles are multiplied by half the diagonal."""
    gx, gy = scene.clearance.horizontal_m, scene.clearance.vertical_m
    radius = 0.5 * np.hypot(scene.frame.width_m, scene.frame.height_m)
    return float((np.abs(q - reference_q) / np.array([gx, gy, gx / radius])).max())


def gaps_at(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Return the exact gaps [m] of the pairs at poses (n, 3), shape (n, 8)."""
    c, s = np.cos(q[:, 2]), np.sin(q[:, 2])
    body = [c, s, c * q[:, 0] + s * q[:, 1], -s * q[:, 0] + c * q[:, 1], np.ones(len(q))]
    gaps: np.ndarray = -np.stack(body, axis=1) @ penetration_rows(scene)
    return gaps


def wall_and_point(
    contact: Contact,
    *,
    speed: float,
    mass: float = 2.0,
    gravity: float = 0.0,
    gap: float = 0.01,
    pairs: tuple[str, ...] = ("top_left_top",),
) -> Scene:
    """Return a mass that can move only vertically, and starts `gap / 2` above the corner on which it falls."""
    return Scene(
        head=Head(mass, 1.0),
        frame=Frame(0.2, 0.2),
        clearance=Clearance(gap, gap),
        contact=contact,
        gravity=Gravity(gravity),
        initial=Initial((0.0, 0.0, 0.0), (0.0, -speed, 0.0)),
        locked=("x", "theta"),
        pairs=pairs,
    )


#: Side [m], mass [kg], moment of inertia [kg m^2] and friction of `tumbling_block`.
SIDE, MASS = 0.06, 1.0
INERTIA = MASS * SIDE**2 / 6.0
MU, SLIP_SPEED = 0.2, 0.05


def tumbling_block(*, contact: Contact, **changes: object) -> Scene:
    """Return a square block above a table 1 m below the centre of the cavity. It never touches the other walls."""
    scene = Scene(
        Head(MASS, INERTIA, carries="corners"),
        Frame(SIDE, SIDE),
        Clearance(2.0 - SIDE, 2.0 - SIDE),
        contact,
        Gravity(),
        initial=Initial(q=(0.0, -0.85, 0.3), v=(0.4, 0.0, 6.0)),
        friction=Friction(MU, SLIP_SPEED),
    )
    return replace(scene, **changes)  # type: ignore[arg-type]


#: An inertia so large that no moment of the tests turns the head, and a harmonic moment.
FIRM, TURNING_NOTHING = 1e18, Harmonic("turning nothing", (0.0, 0.0), 2.0, moment_n_m=1e3)


def with_presets_terms(scene: Scene) -> Scene:
    """Return a scene with the same motion and the terms of the presets, whose kernels are already compiled.

    A large inertia prevents rotation instead of a locked angle, so the head must not be pushed sideways. Under the
    harmonic moment, the solver does not search for rest.
    """
    return replace(scene, head=replace(scene.head, inertia_kg_m2=FIRM), loads=(TURNING_NOTHING,), locked=())
