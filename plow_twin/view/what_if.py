"""Curves of the largest contact forces of different scenes under the load of a run, beside the forces of the run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr

from plow_twin.errors import RecordingError
from plow_twin.model.scene import Scene
from plow_twin.record.entries import Entries
from plow_twin.record.header import RunHeader
from plow_twin.record.walking import JournalWalk, Walked, Walker
from plow_twin.run.twin import Twin
from plow_twin.stream.session import Session
from plow_twin.view import layout
from plow_twin.view.columns import Array, Curves, Indexes, TimeAxis


class WhatIf:
    """Simulation of different scenes with the journal of a run, and curves of their forces.

    If the journal contains no load, because the run used the loads of its own scene, `RecordingError` is raised.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        axis: TimeAxis,
        header: RunHeader,
        others: Mapping[str, Scene],
        span_ns: int,
    ) -> None:
        if others and header.excitation_source == "scene":
            raise RecordingError("other scenes: excitation_source: got scene, expected a run under sampled loads")
        entities = layout.what_if_curves(stream, tuple(others)) if others else ()
        self._curves = [Curves(stream, axis, [entity], span_ns) for entity in entities]
        self._walk = JournalWalk((), [self._walker(header, scene, n + 1) for n, scene in enumerate(others.values())])
        self._stamps = self._steps = np.zeros(0, np.int64)

    def _walker(self, header: RunHeader, scene: Scene, number: int) -> Walker:
        def draw(walked: Walked) -> None:
            place = np.searchsorted(self._stamps, walked.stamp_ns)
            self._curves[number].add(walked.stamp_ns, self._steps[place], _largest_kn(walked.rows.peak))

        twin = Twin(scene, tol=header.tol, excitation="sampled")
        return Walker(Session(twin, header.origin_ns), draw)

    @property
    def lost(self) -> dict[str, int]:
        """Number of samples that came too late for the simulated scenes."""
        return {"samples_too_late": self._walk.late} if self._walk.late else {}

    def add(self, entries: Entries, stamps: Indexes, steps: Indexes) -> None:
        """Advance the simulated scenes by entries of the journal."""
        if self._curves:
            order = np.argsort(stamps[entries.sample], kind="stable")
            self._stamps, self._steps = stamps[entries.sample][order], steps[entries.sample][order]
            self._walk.add(entries)

    def run(self, stamps: Indexes, steps: Indexes, peak: Array) -> None:
        """Draw the largest forces [N] of the run, shape (n, 8)."""
        if self._curves:
            self._curves[0].add(stamps, steps, _largest_kn(peak))

    def end_lines(self) -> None:
        """End the lines. The next rows begin new lines."""
        for curve in self._curves:
            curve.end()

    def flush(self) -> None:
        """Send the buffered rows."""
        for curve in self._curves:
            curve.flush()


def _largest_kn(peak: Array) -> Array:
    largest: Array = peak.max(axis=1, keepdims=True) / 1e3
    return largest
