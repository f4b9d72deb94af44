"""Feed the load from any recording to twins, with the input checks and the journal of a live run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from plow_twin.errors import RecordingError
from plow_twin.model.scene import DOF_NAMES
from plow_twin.record.mapping import Role, readings
from plow_twin.record.sources import Arrived
from plow_twin.record.walking import BATCH, Walker
from plow_twin.stream.driver import Policy
from plow_twin.stream.intake import Intake, Verdict
from plow_twin.stream.journal import PartOfPose, Pose, Reset, Travel, pose_entry
from plow_twin.stream.silences import Silences
from plow_twin.stream.steps import Steps


@dataclass
class Feed:
    """Pass the messages of a recording to walkers in the order of their arrival, after a check of each load sample.

    The function `measured` receives the role, the stamp [ns] and the values of each message that contains neither a
    load nor a speed.
    """

    walkers: list[Walker]
    roles: dict[str, Role]
    measured: Callable[[str, int, dict[str, float]], object]
    intake: Intake = field(default_factory=Intake)
    #: numbers of messages that do not fit their role, by reason
    unfit: Counter[str] = field(default_factory=Counter)
    #: whether measured poses are written to the journal of `walkers[0]`, which records the run
    with_poses: bool = False
    #: intervals without samples, in which the twin interpolates the load linearly
    silences: Silences = field(default_factory=lambda: Silences(Policy.excitation_timeout_s))
    _poses: list[Pose | PartOfPose] = field(default_factory=list)
    #: stamp [ns], load and receive time [ns] of each buffered sample
    _samples: list[tuple[int, tuple[float, float, float], int]] = field(default_factory=list)
    _reached_ns: int | None = None

    def __post_init__(self) -> None:
        self._steps = Steps(self.intake)

    def run(self, messages: Iterable[Arrived]) -> None:
        """Process all messages and close the walkers. Raise `RecordingError` if no load sample can be used."""
        for name, arrived, found in readings(messages, self.roles):
            if arrived.after_hole:
                self._hole()
            if found is not None:
                self._add(name, *found, arrived.log_time_ns)
            else:
                self.unfit[f"{name}: {self.roles[name].why_unfit(arrived)}"] += 1
                if name == "excitation":
                    self.intake.refuse(Verdict.MALFORMED)
        self._steps.end()
        self.flush()
        if not self.intake.used:
            topic = self.roles["excitation"].topic if "excitation" in self.roles else "none"
            refused = ", ".join(f"{verdict.value} {count}" for verdict, count in self.intake.counts.items() if count)
            reason = "".join(f"; {text}" for text in self.unfit if text.startswith("excitation: "))
            raise RecordingError(
                f"excitation: got no usable sample (topic {topic}: {refused or 'no message'}{reason}), "
                "expected at least one"
            )
        for walker in self.walkers:
            walker.close()

    def _hole(self) -> None:
        """Reset the walkers after missing messages, so that no load is interpolated across the gap."""
        self._steps.end()
        self.flush()
        self.silences.restart()
        if self._reached_ns is not None:
            for walker in self.walkers:
                walker.apply(Reset(self._reached_ns, "loss"))

    def _add(self, name: str, stamp_ns: int, values: dict[str, float], log_time_ns: int) -> None:
        if name == "travel":
            speed = values["speed"]
            if math.isfinite(speed) and any(speed != walker.session.travel_speed_m_s for walker in self.walkers):
                self.flush()
                for walker in self.walkers:
                    # a new speed takes effect at the stamp of the newest sample
                    walker.apply(Travel(self._reached_ns or 0, speed), max(0, log_time_ns))
        elif name == "excitation":
            wrench = (values["fx"], values["fy"], values["m"])
            for settled in self._steps.settle(stamp_ns, wrench, log_time_ns, self._reached_ns):
                self._sample(*settled)
        elif stamp_ns > 0:
            self.measured(name, stamp_ns, values)
            if self.with_poses and name == "head_pose":
                self._poses.append(pose_entry(stamp_ns, tuple(values.get(axis, math.nan) for axis in DOF_NAMES)))
        else:
            self.unfit[f"{name}: {self.roles[name].topic} has stamps of 0"] += 1

    def _sample(self, stamp_ns: int, wrench: tuple[float, float, float], log_time_ns: int) -> None:
        verdict = self.intake.judge(stamp_ns, wrench, self._reached_ns)
        if not verdict.used:
            return
        if verdict.resets:
            self.flush()
            self.silences.restart()
            for walker in self.walkers:
                walker.apply(Reset(stamp_ns, verdict.value), max(0, log_time_ns))
        self._reached_ns = stamp_ns
        self._samples.append((stamp_ns, wrench, max(0, log_time_ns)))
        if len(self._samples) >= BATCH:
            self.flush()

    def flush(self) -> None:
        """Apply the buffered poses, and then advance the walkers by the buffered samples."""
        first_ns = self._samples[0][2] if self._samples else 0
        for pose in self._poses if self._samples or self._reached_ns is not None else ():
            self.walkers[0].apply(pose, first_ns)
        self._poses = []
        if not self._samples:
            return
        stamp_ns, loads, log_time_ns = zip(*self._samples, strict=True)
        stamps, wrench, times = np.array(stamp_ns, np.int64), np.array(loads), np.array(log_time_ns, np.int64)
        self._samples = []
        self.silences.add(stamps)
        for walker in self.walkers:
            walker.samples(stamps, wrench, times)
