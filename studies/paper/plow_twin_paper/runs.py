"""The runs for the comparison with the paper, all computed from one scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import Problem, SceneError, SolverError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Clearance, Harmonic, Scene
from plow_twin.run.ensemble import simulate_many
from plow_twin.run.simulate import Result, output_times, simulate
from plow_twin.solve.state import Status
from plow_twin_paper.rotation import Rotation, rotation_scenes
from plow_twin_paper.sets import letters_of_pairs
from plow_twin_paper.values import (
    CASE_M,
    CORNERS,
    FACE_GRID_M,
    FACE_T_END_S,
    FACES,
    FIXED_M,
    GRID_M,
    OMEGA_RAD_S,
    PERIOD_S,
)

Array = NDArray[np.float64]
OnProgress = Callable[[float], object]

#: Length of the shortest run [s]: two load periods, of which the second is treated as settled.
SHORTEST_S: Final = 2.0 * PERIOD_S
#: Length of the longest run [s]. Its output for the three models of rotation takes about one gigabyte.
LONGEST_S: Final = 1000.0
#: Output interval for figures [s]. Forces change within tens of milliseconds.
OUTPUT_DT_S: Final = 1e-3
#: Number of steps of a computed curve between two of the five points that are read from the paper's curves.
_FINE_STEPS: Final = 10


@dataclass(frozen=True)
class Sweep:
    """Largest force of each corner [N], shape (n, 4), as a function of the clearance [m], shape (n,)."""

    clearance_m: Array
    largest_n: Array

    def on_grid(self) -> Array:
        """Return the forces at the five clearances of the paper, shape (5, 4)."""
        return self.largest_n[::_FINE_STEPS]


@dataclass(frozen=True)
class FaceRun:
    """Force on each of the `FACES` [N], shape (n, 4), at a clearance [m]; NaN if the run failed."""

    clearance_m: float
    t: Array
    face_n: Array

    @property
    def failed(self) -> bool:
        """True if the motion could not be continued to the end."""
        return bool(np.isnan(self.face_n).any())


@dataclass(frozen=True)
class PaperRuns:
    """All runs, with their scene and settings."""

    scene: Scene
    t_end: float
    #: Ratio of the scene's clearances (horizontal, vertical) to the published clearances.
    scale: tuple[float, float]
    #: Run of Figs 6 to 9, which is always complete.
    case: Result
    vertical: Sweep
    horizontal: Sweep
    faces: FaceRun
    faces_vertical: tuple[FaceRun, ...]
    faces_horizontal: tuple[FaceRun, ...]
    rotation: Rotation | None
    #: Number of runs that could not be completed.
    failed: int


def _check_scene(scene: Scene) -> None:
    problems = []
    if tuple(sorted(scene.frame.labels)) != CORNERS:
        problems.append(
            Problem("frame.labels", dict(scene.frame.labels), "the letters a, b, c, d, one for each corner")
        )
    omegas = {load.omega_rad_s for load in scene.loads if isinstance(load, Harmonic)}
    if omegas != {OMEGA_RAD_S}:
        problems.append(Problem("loads", sorted(omegas), f"harmonics of {OMEGA_RAD_S:g} rad/s, as the paper has them"))
    for name, value in zip(("horizontal_m", "vertical_m"), _clearances(scene), strict=True):
        if not value > 0.0:
            problems.append(Problem(f"clearance.{name}", value, "a clearance > 0 [m]"))
    if problems:
        raise SceneError(problems, "comparison with the paper")


def run_all(
    scene: Scene, t_end: float, workers: int | None = None, on_progress: OnProgress = lambda share: None
) -> PaperRuns:
    """Run everything that the figures and the table need.

    The clearance of the scene corresponds to Figs 6 to 9 of the paper. All other clearances of the paper are multiplied
    by the ratio of the scene's clearance to the published clearance. The runs of section 5 end at 20 s, or at `t_end`
    if it is smaller. Rows whose run fails are not computed.

    Raises
    ------
    SceneError
        The labels, loads or clearances of the scene prevent a comparison.
    SolverError
        The run of Figs 6 to 9 could not be continued.
    """
    _check_scene(scene)
    scale = (scene.clearance.horizontal_m / CASE_M[0], scene.clearance.vertical_m / CASE_M[1])
    case = simulate(scene, t_end, OUTPUT_DT_S)
    rotation, lost = _rotation(scene, t_end)
    on_progress(0.1)
    sweeps, failed = _sweeps(scene, scale, t_end, workers, on_progress)
    end = min(FACE_T_END_S, t_end)
    vertical = [_face_run(_at(scene, scale, FIXED_M, value), value, end) for value in FACE_GRID_M]
    horizontal = [_face_run(_at(scene, scale, value, FIXED_M), value, end) for value in FACE_GRID_M]
    rows = case.t <= end
    faces = FaceRun(CASE_M[1], case.t[rows], _face_forces(case.force[rows]))
    failed += lost + sum(run.failed for run in (*vertical, *horizontal))
    on_progress(1.0)
    return PaperRuns(
        scene, t_end, scale, case, *sweeps, faces, tuple(vertical), tuple(horizontal), rotation, failed,
    )  # fmt: skip


def _sweeps(
    scene: Scene, scale: tuple[float, float], t_end: float, workers: int | None, on_progress: OnProgress
) -> tuple[tuple[Sweep, Sweep], int]:
    """Return the curves of Figs 10 and 11, and the number of failed runs. The forces of a failed run are NaN."""
    fine = np.linspace(GRID_M[0], GRID_M[-1], _FINE_STEPS * (len(GRID_M) - 1) + 1)
    cells = [(FIXED_M, value) for value in fine] + [(value, FIXED_M) for value in fine]
    scenes = [_at(scene, scale, *cell) for cell in cells]

    def on_member(done: int) -> None:
        on_progress(0.1 + 0.8 * done / len(scenes))

    many = simulate_many(scenes, t_end, t_end, workers=workers, on_progress=on_member)
    good = many.status == Status.OK
    largest = _by_corner(scene, np.where(good[:, None], many.peak, np.nan))
    vertical, horizontal = largest[: len(fine)], largest[len(fine) :]
    return (Sweep(fine, vertical), Sweep(fine, horizontal)), int((~good).sum())


def _clearances(scene: Scene) -> tuple[float, float]:
    return scene.clearance.horizontal_m, scene.clearance.vertical_m


def _at(scene: Scene, scale: tuple[float, float], horizontal_m: float, vertical_m: float) -> Scene:
    return replace(scene, clearance=Clearance(float(scale[0] * horizontal_m), float(scale[1] * vertical_m)))


def _by_corner(scene: Scene, peak: Array) -> Array:
    """Return the larger peak of the two pairs at each corner, shape (m, 4)."""
    letters = letters_of_pairs(scene)
    pairs = [[pair for pair, letter in enumerate(letters) if letter == corner] for corner in CORNERS]
    return np.stack([peak[:, index].max(axis=1) for index in pairs], axis=1)


def _face_run(scene: Scene, clearance_m: float, t_end: float) -> FaceRun:
    try:
        result = simulate(scene, t_end, OUTPUT_DT_S)
    except SolverError:
        times = output_times(t_end, OUTPUT_DT_S)
        return FaceRun(clearance_m, times, np.full((len(times), len(FACES)), np.nan))
    return FaceRun(clearance_m, result.t, _face_forces(result.force))


def _rotation(scene: Scene, t_end: float) -> tuple[Rotation | None, int]:
    """Return the three models of rotation, or None if one fails, and the number of failures."""
    try:
        return rotation_scenes(scene, t_end, OUTPUT_DT_S), 0
    except SolverError:
        return None, 1


def face_of_pair() -> list[str]:
    """Return the inner face that each pair touches, shape (8,)."""
    return [name.rpartition("_")[2] for name in PAIR_NAMES]


def _face_forces(force: Array) -> Array:
    """Return the force on each inner face [N], shape (n, 4), given the forces of the pairs, shape (n, 8)."""
    faces = face_of_pair()
    pairs = [[pair for pair, name in enumerate(faces) if name == face] for face in FACES]
    return np.stack([force[:, chosen].sum(axis=1) for chosen in pairs], axis=1)
