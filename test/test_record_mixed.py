"""Whatever comes, in whatever order: a replay of the recording gives each message and each alarm of the live run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from plow_twin.live import parameters
from plow_twin.live.publishing import Publishing
from plow_twin.live.recording import Recording
from plow_twin.live.runtime import policy
from plow_twin.model.scene import Wear
from plow_twin.record.alarms import alarms_of
from plow_twin.record.messages import DiagnosticStatus, JointState
from plow_twin.record.outputs import PUBLICATION_TOPICS
from plow_twin.record.replay import replay
from plow_twin.record.replay_report import ReplayReport
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.driver import Arrival, Driver
from plow_twin.stream.intake import NS_PER_S, Intake
from plow_twin.stream.outputs import Publication
from plow_twin.stream.session import Session

WEAR = Wear(coefficient_m2_n=1e-12, pad_area_m2=0.015, travel_speed_m_s=2.0)
SCENE = replace(load_scene(scene_path("paper")), wear=WEAR)
T0 = 1_795_000_000_000_000_000
MS = NS_PER_S // 1000
NOTHING = (0.0, 0.0, 0.0)
TOPICS = {name: f"/{name}" for name in (*PUBLICATION_TOPICS, "alarms", "quality")}


class Front:
    """Where the messages go: they are kept."""

    name, topics, follows_samples = "/plow_twin", TOPICS, True

    def __init__(self) -> None:
        self.frames: list[Publication] = []
        self.alarms: list[DiagnosticStatus] = []

    def publish(self, publication: Publication, forces_sent: Callable[[], None]) -> Mapping[str, bytes] | None:
        if not publication.finite:
            return None
        self.frames.append(publication)
        return {}

    def publish_alarms(self, status: DiagnosticStatus) -> None:
        self.alarms.append(status)

    def publish_quality(self, marks: JointState) -> None:
        pass

    def publish_estimate(self, topic: str, message: JointState) -> None:
        raise NotImplementedError

    def changed(self) -> None:
        raise NotImplementedError

    def now_ns(self) -> int:
        raise NotImplementedError

    def say_error(self, text: str) -> None:
        pytest.fail(text)


class Mixed:
    """A live twin that is recorded, driven by calls at times `ms` of a steady clock."""

    def __init__(self, folder: Path, **values: Any) -> None:
        self.settings = parameters.settings({"record_path": str(folder / "run")} | values)
        self.front, self.ms = Front(), 0
        self.recording = Recording(self.settings, SCENE, "/plow_twin", TOPICS, None, pytest.fail)
        self.alarms = alarms_of(vars(self.settings))
        self.publishing = Publishing(self.front, self.settings, self.alarms, self.recording, lambda text: None)
        bound = self.settings.max_evaluations or None
        twin = Twin(SCENE, tol=self.settings.tolerance, excitation="sampled", max_evaluations=bound)
        session = Session(twin, on_entry=self.recording.journal, rollback_span_s=self.settings.rollback_span)
        intake = Intake(jump_back_s=60.0)  # no limits: an advance may fail
        every_sample = self.settings.publish_mode == "on_sample"
        self.driver = Driver(session, intake, policy(self.settings), every_sample=every_sample)
        session.start()

    def send(self, *arrived: Arrival) -> None:
        for publication in self.driver.samples(arrived, self.ms * MS):
            self.publishing.publish(publication)

    def silence(self, ms: int) -> None:
        self.ms += ms
        self.publishing.publish(self.driver.silence(self.ms * MS))

    def publish_due(self) -> None:
        self.publishing.publish(self.driver.due())

    def replayed(self) -> ReplayReport:
        self.driver.close()
        self.recording.close()
        return replay(self.recording.path)


def _at(ms: float, load: tuple[float, float, float]) -> Arrival:
    return T0 + round(ms * MS), load


def _swinging(ms: float) -> Arrival:
    share = math.sin(0.02 * ms)
    return _at(ms, (60e3 * share, 9e3 * math.cos(0.05 * ms), -45e3 * share))


def _same(report: ReplayReport) -> bool:
    assert report.first_divergence is None, (report.divergences, report.first_divergence)
    return report.exit_code == 0 and not report.not_compared


def test_a_late_speed_does_not_reach_back_across_a_snapshot(tmp_path: Path) -> None:
    live = Mixed(tmp_path)
    live.send(*map(_swinging, range(200)))
    live.driver.snapshot()
    live.driver.travel(T0 + 150 * MS, 0.5)
    live.send(*map(_swinging, range(200, 300)))
    assert _same(live.replayed())


def test_after_a_hold_and_a_reset_samples_are_not_taken_for_held(tmp_path: Path) -> None:
    live = Mixed(tmp_path, publish_mode="fixed_rate", alarm_force=[1e3, 1e9], excitation_timeout=0.05)
    live.send(_at(0, NOTHING))
    live.silence(100)
    live.driver.reset(T0, "asked for")
    live.send(*map(_swinging, range(200, 300)))
    live.driver.parameter("hold_limit", 31.0)
    live.publish_due()
    report = live.replayed()
    assert _same(report) and report.compared["alarms"] == len(live.front.alarms) == 1
