"""Read the estimates of a live node from its journal, and the scene at the end of a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from plow_twin.errors import RecordingError
from plow_twin.estimate.measurements import UNSTATED, Deviation
from plow_twin.estimate.window import Window, Windows
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Scene
from plow_twin.record.cdr import decode
from plow_twin.record.messages import JointState
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.stream import journal
from plow_twin.stream.model_changes import changed_scene, read_changes
from plow_twin.stream.snapshot import SessionState
from plow_twin.stream.topics import JOINT_STATE


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

    An estimate before the last setting of the wear is not returned. Without outputs, the wear is that of the last entry
    that contains it.
    """
    scene, newest = reader.header.scene(reader.path), None
    depth, changes, sequence = None, dict[str, float](), 0
    for batch in reader.batches(outputs=False):
        for index, entry in sorted(batch.entries.others.items()):
            match entry:
                case journal.Estimated():
                    newest = entry
                case journal.SetWear(_, set_depth):
                    newest, depth, sequence = None, set_depth, int(batch.entries.sequence[index])
                case journal.SetModel(_, text):
                    changes = read_changes(text)
                case journal.Snapshot(_, data):
                    depth = tuple(SessionState.unpack(data).wear_depth.tolist())
                    sequence = int(batch.entries.sequence[index])
    if reader.status is not FileStatus.TRUNCATED:
        depth = _last_published_depth(reader, sequence) or depth
    scene = changed_scene(scene, changes)
    if depth is not None and scene.wear is not None:
        scene = replace(scene, wear=replace(scene.wear, initial_depth_m=depth))
    return scene, newest


def _last_published_depth(reader: RunReader, after: int) -> tuple[float, ...] | None:
    """Return the wear depths [m] in the last message on `clearance`, or None if it precedes entry number `after`."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    topic = reader.header.topic("clearance")
    try:
        with reader.parts[-1].open("rb") as stream:
            _, _, message = next(make_reader(stream).iter_messages([topic], reverse=True))
        numbers = decode(message.data, JOINT_STATE)
    except (OSError, StopIteration, McapError, RecordingError):
        return None
    assert isinstance(numbers, JointState)
    if (message.sequence - after) % 2**32 >= 2**31:
        return None
    return tuple(map(float, numbers.position[2 : 2 + PAIR_COUNT]))


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
