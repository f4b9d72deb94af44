"""The two bench scenes, their reference trajectories, and their constants for solvers without a `Scene` class."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from cases import Array

from plow_twin import Harmonic, Scene
from plow_twin.model.geometry import half_diagonal
from plow_twin.scene_file import load_scene

ROOT = Path(__file__).resolve().parent.parent
#: Folder with references on a 1 ms grid. It is outside the repository and is used only if it exists.
FINE_REFERENCE = ROOT.parent / "shared" / "reference"
NAMES = ("kv", "hc")
T_END = 20.0
#: Intervals [s] between rows of the two output grids.
SPARSE, DENSE = 0.1, 1e-3


def bench_scene(name: str) -> Scene:
    return load_scene(ROOT / "config" / f"bench_{name}.yaml")


def error_scale(scene: Scene) -> tuple[float, float, float]:
    """Return the scales of the errors of x, y and theta: gx, gy, and gx divided by half the diagonal."""
    gx, gy = scene.clearance.horizontal_m, scene.clearance.vertical_m
    return gx, gy, gx / half_diagonal(scene)


def reference_poses(name: str) -> tuple[Array, float]:
    """Return the reference poses over 20 s, shape (n, 3), and the interval between them [s]."""
    fine = FINE_REFERENCE / f"bench_{name}.npz"
    path, dt = (fine, 1e-3) if fine.exists() else (ROOT / "test" / "data" / f"bench_{name}.npz", 1e-2)
    with np.load(path) as archive:
        return archive["q"], dt


def on_grid(name: str, output_dt: float) -> tuple[Array, int]:
    """Return the reference poses at times of the output, and the number of output rows per pose."""
    q, dt = reference_poses(name)
    if dt <= output_dt:
        return q[:: round(output_dt / dt)], 1
    return q, round(dt / output_dt)


def constants(scene: Scene) -> Array:
    """Return the 15 constants of a bench scene: width, height, gx, gy, mass, inertia, gravity, arm, K, exponent, C or
    lambda, Fx, Fy, M, omega.

    The load of the scene must be a single harmonic with phase 0.
    """
    if len(scene.loads) != 1 or not isinstance(scene.loads[0], Harmonic) or scene.loads[0].phase_rad != 0.0:
        raise ValueError(f"loads: got {scene.loads!r}, expected one Harmonic without phase")
    load, contact = scene.loads[0], scene.contact
    return np.array([
        scene.frame.width_m, scene.frame.height_m, scene.clearance.horizontal_m, scene.clearance.vertical_m,
        scene.head.mass_kg, scene.head.inertia_kg_m2, scene.gravity.acceleration_m_s2, scene.gravity.arm_m,
        contact.stiffness, contact.exponent, contact.damping or 0.0, *load.force_n, load.moment_n_m, load.omega_rad_s,
    ])  # fmt: skip
