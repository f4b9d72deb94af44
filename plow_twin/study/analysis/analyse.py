"""Analysis of one recording: the motion is computed under the recorded load and compared with the measurements.

The load comes from the journal of a run, or from a mapped topic of another recording. A *stretch* is the motion between
two resets. Signals are compared over the longest stretch. Contacts are counted over all stretches.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.record.bag import readable_beside
from plow_twin.record.follow import Tail
from plow_twin.record.importing import Feed
from plow_twin.record.mapping import UNFIT, Role, messages_of, read_map, readings, roles_by_source, with_units
from plow_twin.record.reader import FileStatus, RunReader, own_run
from plow_twin.record.replay import following_twin
from plow_twin.record.run_time import RunTime
from plow_twin.record.sources import open_source
from plow_twin.record.unit_check import check_units
from plow_twin.record.walking import JournalWalk, Walked, Walker
from plow_twin.run.twin import Twin
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.stream.driven import Driven
from plow_twin.stream.intake import Intake
from plow_twin.stream.journal import Loss, Pose, Reset, Restore, SetWear
from plow_twin.stream.outputs import CLEARANCE_NAMES
from plow_twin.stream.session import Session
from plow_twin.stream.silences import Silences
from plow_twin.study.analysis.loads import LoadTotals
from plow_twin.study.analysis.signals import Comparison, compare
from plow_twin.study.analysis.thinned import Thinned

Array = NDArray[np.float64]

_COLUMNS: Final = (
    *("x", "y", "theta"),
    *(f"force_{name}" for name in PAIR_NAMES),
    *(f"gap_{name}" for name in PAIR_NAMES),
)
#: Tolerance of the solver for recordings of other programs.
_TOLERANCE: Final = 1e-9
#: A stamp that is older than the newest stamp by more than this time [ns] shows that the clock has stepped back.
_STEP_NS: Final = 1_000_000_000
#: Measured values above this number are not used, because their squares may overflow.
_LARGEST: Final = 1e15
_OF_THE_RUN: Final = "of the run"
_MAP: Final = "map_"
#: Parameter in the header of each run that an analysis has written, and of no other run.
MAPPED_LOAD: Final = f"{_MAP}excitation"
#: Callback that receives the share of the work done, 0..1.
OnProgress = Callable[[float], object]


@dataclass
class Prediction:
    """The motion of one scene under the recorded load, and the loads of its contacts."""

    name: str
    scene: Scene
    loads: LoadTotals
    longest: Thinned = field(default_factory=lambda: Thinned(len(_COLUMNS)))
    present: Thinned = field(default_factory=lambda: Thinned(len(_COLUMNS)))
    #: Number of resets so far, which is the index of the present stretch.
    resets: int = 0
    #: First and last stamp [ns] of each stretch.
    spans: dict[int, tuple[int, int]] = field(default_factory=dict)
    _longest_number: int = 0
    #: Clearances of all stretches, with the columns `CLEARANCE_NAMES`.
    clearance: Thinned = field(default_factory=lambda: Thinned(len(CLEARANCE_NAMES)))

    def walked(self, part: Walked) -> None:
        """Add a batch of computed rows."""
        self.loads.add(part)
        rows, slow = part.rows, part.published.slow
        first, _ = self.spans.get(self.resets, (int(part.stamp_ns[0]), 0))
        self.spans[self.resets] = first, int(part.stamp_ns[-1])
        self.present.add(part.stamp_ns, np.hstack((rows.q, rows.force, -rows.penetration)))
        self.clearance.add(slow["stamp_ns"], slow["clearance"])

    def is_inside(self, signal: Thinned) -> NDArray[np.bool_]:
        """Return for each measured value whether its stamp lies in a stretch of the load."""
        stamps = signal.series()[0]
        if not self.spans:
            return np.ones(len(stamps), np.bool_)
        inside = [(stamps >= first) & (stamps <= last) for first, last in self.spans.values()]
        return np.asarray(np.any(inside, axis=0))

    def outside(self, signal: Thinned) -> int:
        """Return the number of values of a signal that have a stamp in no stretch of the load."""
        inside = self.is_inside(signal)
        return round(signal.rows * (1.0 - float(inside.mean()))) if len(inside) else 0

    def restart(self) -> None:
        """Begin a new stretch after a reset. Its stamps may be earlier than those of the previous stretch."""
        self.loads.restart()
        self._longest_number = self.longest_number
        self.longest, self.present = self._longer(), Thinned(len(_COLUMNS))
        self.resets += 1

    @property
    def longest_number(self) -> int:
        """Index of the longest stretch."""
        return self.resets if self._longer() is self.present else self._longest_number

    def is_of_longest(self, signal: Thinned) -> NDArray[np.bool_]:
        """Return for each measured value whether it belongs to the longest stretch.

        A value belongs to the stretch that contains its stamp. If several stretches contain the stamp, because the
        clock has stepped back, the value belongs to the stretch in which it arrived.
        """
        at, rows = signal.series()
        if len(self.spans) < 2:
            return np.ones(len(at), np.bool_)
        came, number = rows[:, 1], self.longest_number

        def away(stretch: int) -> Array:
            first, last = self.spans[stretch]
            return np.where((at >= first) & (at <= last), np.abs(came - stretch), np.inf)

        others = np.min([away(stretch) for stretch in self.spans if stretch != number], axis=0)
        return np.asarray(np.isfinite(away(number)) & (away(number) <= others))

    def _longer(self) -> Thinned:
        return self.present if self.present.rows > self.longest.rows else self.longest

    def series(self) -> tuple[NDArray[np.int64], dict[str, Array]]:
        """Return the stamps [ns] and the columns of the longest stretch."""
        stamps, columns = self._longer().series()
        return stamps, {name: columns[:, place] for place, name in enumerate(_COLUMNS)} if len(stamps) else {}

    @property
    def stride(self) -> int:
        """Number n for which every n-th row of the longest stretch is stored."""
        return self._longer().stride


@dataclass
class Measured:
    """Measured values of each signal, in order of arrival."""

    #: Columns of a signal: its value, and the stretch in which the value arrived.
    signals: dict[str, Thinned] = field(default_factory=dict)
    #: Stretch of the latest message of each role, and its newest stamp [ns] in this stretch.
    _latest: dict[str, tuple[int, int]] = field(default_factory=dict)
    implausible: int = 0

    def add(self, role: str, stamp_ns: int, numbers: Mapping[str, float], stretch: int = 0) -> None:
        """Add the finite numbers of a message to the signals."""
        before, newest = self._latest.get(role, (0, stamp_ns))
        back = newest - stamp_ns > _STEP_NS
        # the clock of the measurement may step back before the clock of the load
        stretch = max(stretch, before + back)
        self._latest[role] = stretch, stamp_ns if back else max(newest, stamp_ns)
        prefix = {"forces": "force_", "gaps": "gap_"}.get(role, "")
        for name, value in numbers.items():
            if math.isfinite(value) and abs(value) > _LARGEST:
                self.implausible += 1
            elif math.isfinite(value) and stamp_ns > 0:
                self.signals.setdefault(prefix + name, Thinned(2)).add_row(stamp_ns, value, stretch)


@dataclass
class Analysis:
    """The result of an analysis of one recording."""

    path: Path
    kind: str
    predictions: list[Prediction]
    measured: Measured
    input: dict[str, int]
    losses: dict[str, int]
    unknown_types: dict[str, str]
    #: Times without samples. During a silence, the load is interpolated linearly.
    silences: Silences
    wall_s: float = 0.0
    #: Folders inside the recording that were not analysed, because they are empty or are separate recordings.
    left_out: tuple[Path, ...] = ()

    @property
    def lossy(self) -> bool:
        """True if some data could not be read or used."""
        return bool(self.lost)

    @property
    def lost(self) -> dict[str, int]:
        """Counts of lost data. A signal counts as lost if all its stamps lie outside the time of the load."""
        counts = ((self.predictions[0].outside(signal), signal.rows) for signal in self.measured.signals.values())
        outside = sum(count for count, rows in counts if count == rows)
        facts = {"measured_implausible": self.measured.implausible, "measured_outside_the_load": outside}
        return self.losses | {name: count for name, count in facts.items() if count}

    def comparisons(self, prediction: Prediction) -> dict[str, Comparison]:
        """Compare each measured signal with the prediction of one scene."""
        stamps, columns = prediction.series()
        if not len(stamps):
            return {}
        compared = {}
        times = (stamps - stamps[0]) * 1e-9
        rising = np.concatenate(([True], np.diff(times) > 0.0))
        for name, column in columns.items():
            if name not in self.measured.signals:
                continue
            signal = self.measured.signals[name]
            (at, rows), ours = signal.series(), prediction.is_of_longest(signal)
            comparison = compare(times[rising], column[rising], (at[ours] - stamps[0]) * 1e-9, rows[ours, 0])
            if comparison is not None:
                compared[name] = comparison
        return compared

    def facts(self) -> dict[str, Any]:
        """Return the whole result for JSON. The first prediction is at the top level, and further predictions are under
        `with`.
        """
        first, *others = self.predictions
        return {
            "run": str(self.path),
            "kind": self.kind,
            "scene": first.name,
            **self._prediction(first),
            "with": [{"scene": other.name, **self._prediction(other)} for other in others],
            "input": self.input,
            "lost": self.lost,
            **({"without_samples": self.silences.text()} if self.silences.count else {}),
            "skipped_topics": self.unknown_types,
            **({"left_out": list(map(str, self.left_out))} if self.left_out else {}),
            "wall_s": self.wall_s,
        }

    def _prediction(self, prediction: Prediction) -> dict[str, Any]:
        signals = {name: dict(vars(found)) for name, found in self.comparisons(prediction).items()}
        facts: dict[str, Any] = {"signals": signals, "loads": prediction.loads.facts()}
        outside = {name: prediction.outside(signal) for name, signal in self.measured.signals.items()}
        if any(outside.values()):
            facts["outside"] = {name: count for name, count in outside.items() if count}
        if len(prediction.spans) > 1:
            facts["stretches"] = len(prediction.spans)
            left = {
                name: int((prediction.is_inside(signal) & ~prediction.is_of_longest(signal)).sum())
                for name, signal in self.measured.signals.items()
            }
            facts["not_compared"] = {name: count for name, count in left.items() if count}
        if prediction.stride > 1:
            facts["signals_of_one_row_in"] = prediction.stride
        confusion = self._confusion(prediction)
        return facts if confusion is None else facts | {"contact_set_confusion": confusion}

    def _confusion(self, prediction: Prediction) -> dict[str, dict[str, int]] | None:
        """Return for each pair how often contact was predicted and measured, or None without measured forces."""
        stamps, columns = prediction.series()
        counts = {}
        for name in PAIR_NAMES:
            key = f"force_{name}"
            if key not in self.measured.signals or not len(stamps):
                continue
            signal = self.measured.signals[key]
            at, rows = signal.series()
            values = rows[:, 0]
            inside = (at >= stamps[0]) & (at <= stamps[-1]) & prediction.is_of_longest(signal)
            place = np.minimum(np.searchsorted(stamps, at[inside]), len(stamps) - 1)
            predicted = columns[key][place] > 0.0
            measured = values[inside] > 0.01 * max(1.0, float(np.max(np.abs(values))))
            counts[name] = {
                "both": int((predicted & measured).sum()),
                "predicted_only": int((predicted & ~measured).sum()),
                "measured_only": int((~predicted & measured).sum()),
                "neither": int((~predicted & ~measured).sum()),
            }
        return counts or None


def analyse(
    path: Path,
    *,
    scene: Path | None = None,
    mapping: Path | None = None,
    units: Mapping[str, str] = MappingProxyType({}),
    others: Sequence[Path] = (),
    out: Path | None = None,
    on_progress: OnProgress = lambda share: None,
    tail: Tail | None = None,
    on_caught_up: Callable[[Analysis], object] = lambda found: None,
) -> Analysis:
    """Analyse a recording.

    Parameters
    ----------
    path
        A run of plow_twin, another recording (MCAP, rosbag2's sqlite3, CSV), or a folder with the parts of a recording.
    scene
        Scene file or preset; by default the scene of a run, or `scene.yaml` beside another recording.
    mapping, units
        YAML file that maps topics to roles, and a mapping of units. The mapping `units` contains a unit for each name
        (fx, x, ..., t) for which the unit in the file is wrong.
    others
        Further scenes. The motion is predicted for each of them.
    out
        Folder in which a recording of another program is converted to a run named `run`.
    tail, on_caught_up
        A `Tail` reads a run while it is being recorded. `on_caught_up` receives the result so far, each time the
        analysis has read all recorded data.

    Raises
    ------
    RecordingError, SceneError
        The recording, the mapping or a scene cannot be used, or a unit seems wrong (`UnitError`).
    """
    begin = time.perf_counter()
    if not path.exists():
        raise RecordingError(f"{path}: no such recording")
    reader = own_run(path, tail)
    if tail is not None and reader is None:
        raise RecordingError(f"{path}: expected a run of plow_twin: recordings of other programs cannot be followed")
    if reader is not None:
        own = reader.header.scene(reader.path)
        chosen, name = (own, _OF_THE_RUN) if scene is None else (load_scene(scene), str(scene))
    else:
        file = scene or (path / "scene.yaml" if path.is_dir() else path.with_name("scene.yaml"))
        if scene is None and not file.is_file():
            raise RecordingError(f"{path}: not a run of plow_twin: a scene is needed, expected --scene or {file}")
        chosen, name = load_scene(file), str(file)
    predictions = [Prediction(name, chosen, LoadTotals(chosen))]
    for other in others:
        with_scene = load_scene(other)
        predictions.append(Prediction(str(other), with_scene, LoadTotals(with_scene)))
    if reader is not None:
        if units:
            raise RecordingError(f"{path}: got units, expected no units: a run of plow_twin is in SI")
        walked = _walk_own(reader, path, mapping, predictions, on_progress, on_caught_up)
    else:
        walked = _walk_other(path, mapping, units, predictions, out)
    walked.wall_s = time.perf_counter() - begin
    return walked


def _walker(prediction: Prediction, session: Session, writer: Any = None) -> Walker:
    walker = Walker(session, prediction.walked, writer)
    walker.on_reset = prediction.restart
    return walker


def _failures(walkers: Sequence[Walker]) -> dict[str, int]:
    """Return the number of failed advances, if there are any, as a loss."""
    count = sum(walker.failures for walker in walkers)
    return {"solver_failures": count} if count else {}


def _walk_own(
    reader: RunReader,
    path: Path,
    mapping: Path | None,
    predictions: list[Prediction],
    on_progress: OnProgress,
    on_caught_up: Callable[[Analysis], object],
) -> Analysis:
    header = reader.header
    if header.excitation_source == "scene":
        raise RecordingError(f"{reader.path}: excitation_source: got scene, expected a run under sampled loads")
    own = predictions[0].name == _OF_THE_RUN
    twins: list[Driven] = [Twin(prediction.scene, tol=header.tol, excitation="sampled") for prediction in predictions]
    if own and header.follow != "off":
        twins[0] = following_twin(header, predictions[0].scene)
    pairs = zip(predictions, twins, strict=True)
    walkers = [_walker(prediction, Session(twin, header.origin_ns)) for prediction, twin in pairs]
    walk = JournalWalk(walkers[:1], walkers[1:], whole=not header.part, same_scene=own)
    journalled = Measured()
    run_time = RunTime(header.parameters)

    def so_far() -> Analysis:
        losses = Counter({**reader.lost, **reader.lost_parts})
        if walk.missing:
            losses["journal"] = max(walk.missing, losses.get("journal", 0))
        if walk.late:
            losses["samples_too_late"] = walk.late
        losses.update(_failures(walkers))
        if reader.status not in (FileStatus.COMPLETE, FileStatus.UNREAD):
            losses[reader.status.value] = 1
        measured, unknown, unused = _measured_beside(path, mapping, header.node)
        measured.signals = journalled.signals | measured.signals
        losses.update(unused)
        used = {"samples_used": walk.used}
        return Analysis(reader.path, "run", predictions, measured, used, dict(losses), unknown, run_time.silences)

    for batch in reader.batches(outputs=False):
        stretch = predictions[0].resets
        walk.add(batch.entries)
        run_time.add(batch.entries)
        for _, entry in sorted(batch.entries.others.items()):
            stretch += isinstance(entry, Reset | Loss | SetWear | Restore)
            if isinstance(entry, Pose):
                pose = dict(zip(("x", "y", "theta"), entry.pose, strict=True))
                journalled.add("head_pose", entry.stamp_ns, pose, stretch)
        if not len(batch.entries) and reader.tail is not None:
            on_caught_up(so_far())
        on_progress(reader.position)
    return so_far()


def _measured_beside(path: Path, mapping: Path | None, node: str) -> tuple[Measured, dict[str, str], dict[str, int]]:
    measured, unknown, unused = Measured(), dict[str, str](), Counter[str]()
    folder = path if path.is_dir() else path.parent
    places = [folder] if any(folder.glob("*.mcap")) else []
    sources = [*map(open_source, [*places, *readable_beside(folder, unused)])]
    for number, (source, roles) in enumerate(roles_by_source(sources, mapping, f"{node}/")):
        roles = {name: role for name, role in roles.items() if name not in ("excitation", "travel")}
        for name, arrived, found in readings(messages_of(source, roles) if roles else (), roles):
            if found is None:
                unused[f"{UNFIT}{name}: {roles[name].why_unfit(arrived)}"] += 1
            elif found[0] <= 0:
                unused[f"{UNFIT}{name}: {roles[name].topic} has stamps of 0"] += 1
            else:
                measured.add(name, *found)
        unknown |= source.losses.unknown_types
        for name, count in source.losses.counts.items():
            # the reader of the run counts all losses except these
            if count and (name == "undecodable" or number >= len(places)):
                unused[name] += count
    return measured, unknown, unused


def _walk_other(
    path: Path,
    mapping: Path | None,
    units: Mapping[str, str],
    predictions: list[Prediction],
    out: Path | None,
) -> Analysis:
    source = open_source(path)
    roles = with_units(read_map(mapping, source.topics()), units)
    if "excitation" not in roles:
        topic_list = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(source.topics().items())) or "no topic"
        raise RecordingError(
            f"{path}: excitation: got {topic_list}, expected a topic with the load, or a mapping that names it"
        )
    check_units(messages_of(open_source(path), roles), roles, predictions[0].scene, path)
    writer = _writer(out, predictions[0], roles) if out is not None else None
    walkers = [
        _walker(
            prediction,
            Session(Twin(prediction.scene, tol=_TOLERANCE, excitation="sampled")),
            writer if number == 0 else None,
        )
        for number, prediction in enumerate(predictions)
    ]
    measured = Measured()

    def add(role: str, stamp_ns: int, numbers: dict[str, float]) -> None:
        measured.add(role, stamp_ns, numbers, predictions[0].resets)

    feed = Feed(walkers, roles, add, Intake(), with_poses=writer is not None)
    try:
        feed.run(messages_of(source, roles))
        if writer is not None:
            writer.close({})
    except RecordingError as error:
        unread = [f"{name} {count}" for name, count in source.losses.counts.items() if count]
        unread += [f"{topic} is {kind}" for topic, kind in source.losses.unknown_types.items()]
        raise RecordingError(f"{error} ({', '.join(unread)})" if unread else str(error)) from None
    finally:
        if writer is not None:
            writer.abandon()
    intake = feed.intake
    dropped = {
        f"dropped_{verdict.value}": count for verdict, count in intake.counts.items() if not verdict.used and count
    }
    losses = {**source.losses.counts, **dropped}
    losses |= {f"{UNFIT}{reason}": count for reason, count in feed.unfit.items()}
    losses |= _failures(walkers)
    counted = {"samples_in": intake.arrived, "samples_used": intake.used, **dropped}
    unknown = dict(source.losses.unknown_types)
    return Analysis(path, "other", predictions, measured, counted, losses, unknown, feed.silences)


def _writer(out: Path, prediction: Prediction, roles: Mapping[str, Role]) -> Any:
    from plow_twin.record.header import RunHeader
    from plow_twin.record.writer import RunWriter

    parameters = {"scene": prediction.name} | {f"{_MAP}{name}": role.topic for name, role in roles.items()}
    header = RunHeader(dump_scene(prediction.scene), tol=_TOLERANCE, parameters=parameters)
    return RunWriter(out / "run", header, chunk_size=2**20, min_free_bytes=64 * 1024 * 1024)
