"""Read the estimates of a live node from its journal, and the scene at the end of a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from plow_twin.estimate.measurements import UNSTATED, Deviation
from plow_twin.estimate.window import Window, Windows
from plow_twin.model.scene import Scene
from plow_twin.record.reader import RunReader
from plow_twin.stream import journal
from plow_twin.stream.model_changes import changed_scene, read_changes
from plow_twin.stream.snapshot import SessionState


@dataclass(frozen=True, eq=False)
class LiveEstimate:
    """An estimate from the journal of a node, with its window of measurements.

    The window is computed from the entries of the journal, and is None if measurements are missing.
    """

    entry: journal.Estimated
    window: Window | None


def live_estimates(reader: RunReader) -> Iterator[LiveEstimate]:
    """Yield the estimates of a run in order, with the windows of measurements that the node used."""
    settings = reader.header.parameters
    if not settings.get("estimate"):
        return
    names = ("estimate_window", "estimate_interval", "rollback_span")
    length_s, interval_s, wait_s = (float(settings[name]) for name in names)
    windows = Windows(length_s, interval_s, wait_s, *stated(settings), float(settings.get("gaps_deviation", 0.0)))
    formed: dict[int, Window] = {}

    def note(window: Window | None) -> None:
        if window is not None:
            formed[window.end_ns] = window

    for batch in reader.batches(outputs=False):
        entries = batch.entries
        stamps, wrenches = entries.stamp_ns.tolist(), entries.wrench.tolist()
        for index, is_sample in enumerate(entries.sample.tolist()):
            if is_sample:
                note(windows.add_load(stamps[index], tuple(wrenches[index])))
                continue
            match entries.others[index]:
                case journal.Pose(stamp_ns, pose, deviation):
                    note(windows.add_pose(stamp_ns, pose, deviation))
                case journal.PartOfPose(stamp_ns) as part:
                    note(windows.add_pose(stamp_ns, journal.whole_pose(part)))
                case journal.Gaps(stamp_ns, pairs, gaps):
                    windows.add_gaps(stamp_ns, pairs, gaps)
                case journal.Spread(_, deviation):
                    windows.set_load_deviation(deviation)
                case journal.Reset() | journal.SetWear() | journal.SetModel():
                    windows.restart()
                    formed.clear()
                case journal.Estimated(end_ns=end_ns) as entry:
                    yield LiveEstimate(entry, _whole(formed.get(end_ns) or windows.last(), entry))
                    formed = {end: window for end, window in formed.items() if end > end_ns}


def left_by(reader: RunReader) -> tuple[Scene, journal.Estimated | None]:
    """Return the scene at the end of a run, including wear and changes of the model, and the last estimate.

    An estimate before the last setting of the wear is not returned.
    """
    scene, newest = reader.header.scene(reader.path), None
    depth, changes = None, dict[str, float]()
    for batch in reader.batches(outputs=False):
        for _, entry in sorted(batch.entries.others.items()):
            match entry:
                case journal.Estimated():
                    newest = entry
                case journal.SetWear(_, set_depth):
                    newest, depth = None, set_depth
                case journal.SetModel(_, text):
                    changes = read_changes(text)
                case journal.Snapshot(_, data):
                    depth = tuple(SessionState.unpack(data).wear_depth.tolist())
    scene = changed_scene(scene, changes)
    if depth is not None and scene.wear is not None:
        scene = replace(scene, wear=replace(scene.wear, initial_depth_m=depth))
    return scene, newest


def stated(parameters: Mapping[str, Any]) -> tuple[Deviation, Deviation]:
    """Return the standard deviations of the poses and of the load from the node's parameters."""
    poses, load = (parameters.get(f"{name}_deviation", UNSTATED) for name in ("head_pose", "excitation"))
    return tuple(map(float, poses)), tuple(map(float, load))


def _whole(window: Window | str, entry: journal.Estimated) -> Window | None:
    """Return the window if its bounds and numbers of measurements agree with the entry, otherwise None."""
    if isinstance(window, str):
        return None
    formed = window.start_ns, window.end_ns, window.samples, window.poses
    return window if formed == (entry.start_ns, entry.end_ns, entry.samples, entry.poses) else None
