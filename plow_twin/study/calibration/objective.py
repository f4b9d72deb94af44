"""Objectives of a calibration: residuals from published figures, or from a recorded motion.

A *candidate* is a set of values of the unknowns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.geometry import half_diagonal, length_scale
from plow_twin.model.scene import Scene
from plow_twin.run.ensemble import simulate_many
from plow_twin.solve.state import Status
from plow_twin.study.calibration.pose_recording import PoseRecording
from plow_twin.study.calibration.targets import FAILED_RESIDUAL, TargetSet
from plow_twin.study.parameters import Value, usable_scenes, with_parameters
from plow_twin.study.statistics import statistics_of

Array = NDArray[np.float64]
Values = Mapping[str, Value]


class Objective(Protocol):
    """A sum of squares to be minimised."""

    #: Number of simulated runs so far.
    runs: int

    def residuals(self, candidates: Sequence[Values], cut: float = np.inf) -> Array:
        """Return the weighted residuals of m candidates, shape (m, r).

        The evaluation of a candidate may stop early if its objective certainly exceeds `cut`.
        """


@dataclass
class TargetObjective:
    """Differences from targets; `plow_twin.study.calibration.targets` defines the residuals."""

    scene: Scene
    targets: TargetSet
    workers: int | None = None
    runs: int = 0

    def __post_init__(self) -> None:
        # scenes without marks are made three times as fast
        self.scene = replace(self.scene, marks={})

    def residuals(self, candidates: Sequence[Values], cut: float = np.inf) -> Array:
        """Return the residual times the square root of the weight, shape (m, targets), for m candidates."""
        targets, settings = self.targets.targets, self.targets.settings
        paths = sorted({path for target in targets for path in target.paths})
        table = np.full((len(candidates), len(settings), len(paths)), np.nan)
        everyone = np.arange(len(candidates))
        self._fill(table, candidates, everyone, [0], paths)
        if len(settings) > 1:
            first = np.nansum(self._rows(table, paths, missing=np.nan) ** 2, axis=1)
            candidates_left = np.flatnonzero(np.where(np.isfinite(table[:, 0].sum(axis=1)), first <= cut, False))
            self._fill(table, candidates, candidates_left, list(range(1, len(settings))), paths)
        return self._rows(table, paths, missing=FAILED_RESIDUAL)

    def unweighted(self, candidate: Values) -> Array:
        """Return the unweighted residual of every target for one candidate, shape (targets,)."""
        weights = np.sqrt([target.weight for target in self.targets.targets])
        return np.asarray(self.residuals([candidate])[0] / np.where(weights > 0.0, weights, 1.0))

    def table(self, candidate: Values) -> tuple[Array, list[str]]:
        """Return the statistics of one candidate, shape (settings, paths), and the paths."""
        paths = sorted({path for target in self.targets.targets for path in target.paths})
        table = np.full((1, len(self.targets.settings), len(paths)), np.nan)
        self._fill(table, [candidate], np.arange(1), list(range(len(self.targets.settings))), paths)
        return table[0], paths

    def _fill(
        self, table: Array, candidates: Sequence[Values], rows: NDArray[np.int64], columns: list[int], paths: list[str]
    ) -> None:
        cells = [(row, column) for row in rows for column in columns]
        values = ({**self.targets.settings[column], **candidates[row]} for row, column in cells)
        scenes, places = usable_scenes(self.scene, values)
        if not scenes:
            return
        t_end = self.targets.t_end_s
        members = simulate_many(scenes, t_end, t_end, self.targets.tol, self.workers)
        self.runs += len(scenes)
        for place, numbers in zip(places, statistics_of(members, scenes, paths), strict=True):
            table[cells[place]] = numbers

    def _rows(self, table: Array, paths: list[str], missing: float) -> Array:
        settings = list(self.targets.settings)
        rows = np.zeros((len(table), len(self.targets.targets)))
        for index, target in enumerate(self.targets.targets):
            columns = [settings.index(setting) for setting in target.settings]
            part = table[:, columns][:, :, [paths.index(path) for path in target.paths]]
            bad = np.asarray(np.isnan(part).any(axis=(1, 2)))
            r = target.residual(np.where(bad[:, None, None], 1.0, part))
            rows[:, index] = np.sqrt(target.weight) * np.where(bad, missing, r)
        return rows


@dataclass
class RecordingObjective:
    """Difference from a recorded motion: (q - recorded q) / clearance for every row and coordinate.

    Differences of the angle are multiplied by half the diagonal. Residuals are divided by the square root of their
    number, so that the objective is a mean square error in units of the clearance before the fit.
    """

    scene: Scene
    recording: PoseRecording
    tol: float = 1e-8
    workers: int | None = None
    runs: int = 0

    def __post_init__(self) -> None:
        self.scene = replace(self.scene, marks={})

    def motion(self, candidate: Values) -> Array:
        """Return the simulated poses of a candidate at the recorded times, shape (n, 3)."""
        scene, recording = with_parameters(self.scene, candidate), self.recording
        members = simulate_many([scene], float(recording.t[-1]), recording.output_dt, self.tol, self.workers)
        return np.asarray(recording.sampled(members)[0])

    def residuals(self, candidates: Sequence[Values], cut: float = np.inf) -> Array:
        """Return the residuals of m candidates, shape (m, 3 rows)."""
        del cut
        rows = self.recording.q.size
        result = np.full((len(candidates), rows), FAILED_RESIDUAL / np.sqrt(rows))
        scenes, places = usable_scenes(self.scene, candidates)
        if scenes:
            t_end, dt = float(self.recording.t[-1]), self.recording.output_dt
            members = simulate_many(scenes, t_end, dt, self.tol, self.workers)
            self.runs += len(scenes)
            scale = np.array([1.0, 1.0, half_diagonal(self.scene)]) / length_scale(self.scene) / np.sqrt(rows)
            errors = (self.recording.sampled(members) - self.recording.q) * scale
            sound = members.status == Status.OK
            result[np.array(places)[sound]] = errors[sound].reshape(int(sound.sum()), rows)
        return result
