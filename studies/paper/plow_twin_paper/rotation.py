"""Three models of the head's rotation: a constant moment of gravity, as in the paper, and two exact rigid bodies.

If the centre of mass is not at the centre of the cavity, the mass matrix couples translation and rotation. The paper
omits this coupling and uses a constant moment -m g arm (section 2). The equivalent offset is `com_offset_m = (arm, 0)`.
The paper does not state the reference point of the inertia I, so the exact models take I about the centre of mass and
about the centre of the cavity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Scene
from plow_twin.run.simulate import Result, simulate
from plow_twin_paper import sets as paper_sets
from plow_twin_paper.rows_motion import force_table
from plow_twin_paper.values import CORNERS, SENSE_NAMES

#: Distance [m] above which two motions are treated as separated.
PARTED_M = 1e-3


@dataclass(frozen=True)
class Rotation:
    """Results of the models: constant moment, I about the centre of mass, and I about the centre of the cavity."""

    scenes: tuple[Scene, Scene, Scene]
    results: tuple[Result, Result, Result]
    offset_m: float

    @property
    def parted_s(self) -> float:
        """Time [s] at which the distance of the first two motions first exceeds `PARTED_M`, or NaN."""
        first, second = self.results[:2]
        apart = np.hypot(*(first.q - second.q)[:, :2].T) > PARTED_M
        return float(first.t[np.argmax(apart)]) if apart.any() else float("nan")


@dataclass(frozen=True)
class RotationRow:
    """A quantity of the three runs."""

    what: str
    unit: str
    constant: float
    consistent: float
    consistent_centre: float

    def change(self, value: float) -> float | None:
        """Return the relative difference from the value with the constant moment, or None if this value is zero."""
        return (value - self.constant) / abs(self.constant) if self.constant else None


def rotation_scenes(scene: Scene, t_end: float, output_dt: float) -> Rotation | None:
    """Run the three models of rotation. Return None if gravity has no arm or if the inertia is too small."""
    head, gravity = scene.head, scene.gravity
    offset = gravity.arm_m if head.rotation == "paper" else head.com_offset_m[0]
    about_centre = head.inertia_kg_m2 - head.mass_kg * offset**2
    if offset == 0.0 or about_centre <= 0.0:
        return None
    constant = replace(
        scene,
        head=replace(head, rotation="paper", com_offset_m=(0.0, 0.0)),
        gravity=replace(gravity, arm_m=offset),
    )
    exact = replace(
        scene,
        head=replace(head, rotation="consistent", com_offset_m=(offset, 0.0)),
        gravity=replace(gravity, arm_m=0.0),
    )
    centre = replace(exact, head=replace(exact.head, inertia_kg_m2=about_centre))
    scenes = (constant, exact, centre)
    results = [simulate(form, t_end, output_dt) for form in scenes]
    return Rotation(scenes, (results[0], results[1], results[2]), offset)


def rotation_rows(rotation: Rotation) -> list[RotationRow]:
    """Return forces of the corners, extent of the motion and share of four-point contact for the three models."""
    return [*_forces(rotation), *_poses(rotation), *_sets(rotation)]


def _forces(rotation: Rotation) -> Iterator[RotationRow]:
    tables = [force_table(*run) for run in zip(rotation.scenes, rotation.results, strict=True)]
    for sense, sense_name in SENSE_NAMES.items():
        for corner in CORNERS:
            for statistic, name in (("max", "largest force"), ("mean_in_contact", "mean force in contact")):
                values = [table[sense, corner][statistic] / 1e3 for table in tables]
                yield RotationRow(f"{sense_name}, {corner}: {name}", "kN", *values)


def _poses(rotation: Rotation) -> Iterator[RotationRow]:
    units = (("x", "mm", 1e3), ("y", "mm", 1e3), ("theta", "mrad", 1e3))
    for column, (name, unit, factor) in enumerate(units):
        poses: list[NDArray[np.float64]] = [factor * result.q[:, column] for result in rotation.results]
        yield RotationRow(f"smallest {name}", unit, *(float(pose.min()) for pose in poses))
        yield RotationRow(f"largest {name}", unit, *(float(pose.max()) for pose in poses))


def _sets(rotation: Rotation) -> Iterator[RotationRow]:
    runs = list(zip(rotation.scenes, rotation.results, strict=True))
    for sense, name in SENSE_NAMES.items():
        shares = [100.0 * paper_sets.share_by_size(paper_sets.holds(*run, sense))[3] for run in runs]
        yield RotationRow(f"{name}: all four points at once", "% of contact time", *shares)
