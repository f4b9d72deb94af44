"""Create the `status` message of a twin and the parts of `/diagnostics`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

from plow_twin.live.inputs import OPTIONAL, TOPICS
from plow_twin.live.part import Part
from plow_twin.stream.driver import StreamState, counters
from plow_twin.stream.intake import Intake, Verdict

if TYPE_CHECKING:
    from plow_twin.live.runtime import Runtime

OK, WARN, ERROR = 0, 1, 2

#: Keys of each part of `/diagnostics`, with their descriptions.
KEYS: Final[dict[str, dict[str, str]]] = {
    "state": {
        "lifecycle": "unconfigured, inactive, active or finalized",
        "stream": "state of the stream",
        "reason": "reason of the last failure, which was in configure or in an advance",
        "scene": "scene in use",
        "compile_s": "time in which the solver was compiled or loaded [s]",
        "model_time_s": "model time since configure [s]",
        "real_time_factor": "model seconds per second",
        "real_time_factor_mean": "model seconds per second since the first advance",
        "solver_failures": "failed advances",
        "coarse_advances": "advances that were computed coarsely because of max_evaluations",
        "error_estimate_m": "largest estimated pose error of the coarse advances [m]",
        "resets": "resets of the model",
        "wear_saved": "folder in which the wear is saved",
        "wear_error": "reason why the wear could not be saved",
    },
    "input": {
        "source": "excitation source",
        "samples_in": "samples that arrived",
        "samples_used": "samples to which the model was advanced",
        "rolled_back": "late samples among the used samples",
        "newest_sample_age_s": "time since the stamp of the newest used sample [s]; empty if the stamps are not dates",
        "samples_missing": "missing samples in gaps between stamps, computed with expected_rate",
        "samples_lost": "samples of the followed publisher that never arrived, according to its message numbers",
        "samples_not_followed": "messages of publishers that are not followed",
        "queue_peak": "largest number of messages in the input queue since the last report",
        "queue_wait_ms": "longest wait in the input queue since the last report [ms]",
        "messages_lost": "messages of all inputs that never arrived",
        "dropped_non_finite": "samples with a number that is not finite",
        "dropped_unstamped": "samples whose stamp is zero, negative or after January 2038",
        "dropped_duplicate": "samples with the stamp of another sample",
        "dropped_out_of_order": "samples older than the newest sample and all stored states",
        "dropped_late": "samples newer than the newest sample, but older than all stored states of the model",
        "dropped_implausible": "samples beyond limit_force or another limit",
        "dropped_unsteady": "samples dropped because the stamps had jumped too often",
        "dropped_stray": "samples with a single jump of the stamp, after which the stamps continued as before",
        "dropped_malformed": "messages that cannot be read, or whose names do not match the loads of the scene",
        "dropped_not_selected": "samples on a topic that excitation_source does not select",
        "dropped_inactive": "samples that arrived while the node was not active",
        "dropped_without_clock": "samples that exceeded input_depth before the first message on /clock",
        "jumps_back": "stamps that stepped back by more than jump_back",
        "jumps_forward": "stamps that stepped forward by more than jump_forward",
        "out_of_plane": "used samples, and poses, with components outside the plane, which are ignored",
        "holds": "advances under the hold policy",
        "silences": "intervals without samples longer than excitation_timeout and five times the previous interval",
        "silent_s": "total duration of the counted silences [s]",
        "travel_misplaced": "speeds that took effect immediately, because their stamps are from another clock",
        **{
            f"{topic}_{count}": description
            for topic in OPTIONAL
            for count, description in {
                "used": "messages used",
                "dropped": "messages dropped",
                "implausible": "messages dropped because they exceed the limits of the input",
                "not_followed": "messages of publishers that are not followed",
            }.items()
        },
        "head_pose_residual": "pose of the model minus the last measured pose: x, y [m], theta [rad]",
        "refused_publishers": "publishers with an incompatible type or quality of service",
    },
    "output": {
        "published": "messages on contact_forces",
        "withheld": "messages that were not sent, because a number was not finite",
        "held": "published messages that were computed without a sample",
        "corrected": "published messages that correct an earlier message",
        "latency_p50_ms": "median time from the reading of a sample from the input queue to its forces [ms]",
        "latency_p99_ms": "99 % quantile of this time [ms]",
        "latency_max_ms": "largest value of this time [ms]",
        "age_p50_ms": "median age of the stamp at publication by the system clock [ms]; empty under use_sim_time",
        "age_p99_ms": "99 % quantile of the same age [ms]; empty under use_sim_time",
        "recent_latency_p99_ms": "latency_p99_ms since the last report [ms]",
        "recent_age_p99_ms": "age_p99_ms since the last report [ms]",
        "periods_missed": "missed periods of publish_rate or step_rate",
        "period_mean_ms": "mean period since the last report [ms]",
        "period_deviation_ms": "standard deviation of the period since the last report [ms]",
        "period_max_ms": "longest period since the last report [ms]",
    },
    "estimate": {
        "ready": "1 if the estimator is compiled, otherwise 0",
        "estimates": "estimates since configure",
        "skipped": "windows skipped because a newer window was complete; the computer is then too slow",
        "window_age_s": "time since the end of the last estimated window [s]; empty if the stamps are not dates",
        "wall_s": "computing time of the last estimate [s]",
        "reasons": "reasons why the model or the sensor is suspect",
        "restarts": "times that the process of the estimator has ended and was started again",
        "error": "reason why the estimation has ended",
    },
    "follow": {
        "follow": "off, parameters or full",
        "source": "source of the parameters of the model: prior or estimate",
        "members": "twins that are advanced",
        "members_lost": "twins that have left the range of the model since the last pose",
        "poses_used": "measured poses that corrected the motion of the twins",
        "poses_outlying": "poses that were ignored, because they are too far from their predictions",
        "poses_dropped": "poses dropped because they were an hour ahead of the load or too many poses waited",
        "late_waiting": "late samples of the load that wait until twins have repeated the motion with them",
        "taken_over": "number of times that the twins were drawn again, because an estimate or the machine had changed",
        "reduced": "1 if poses no longer correct the motion, because the twins were too slow",
    },
    "recorder": {
        "recording": "path of the file that is being written",
        "written": "items that were written",
        "queued": "items in the queue",
        "lost": "items that were lost, by topic",
        "marks": "rings that were written",
        "marks_lost": "recordings in memory (record_ring) that could not be written",
        "error": "reason why data were lost or the recording has stopped",
    },
}

#: Keys of `status`, with their descriptions.
STATUS_KEYS: Final[dict[str, str]] = {
    "lifecycle": "unconfigured, inactive, active or finalized",
    "scene": "scene in use",
    "stream": "waiting, running, stale, ended or failed",
    "stale_inputs": "silent inputs, separated by commas",
    "clock": "running; under use_sim_time, the clock can also be waiting (for the first message) or paused",
    "recorder": "off, recording, or trouble (items were lost, or the recording has stopped)",
    "solver_failures": "failed advances, whose samples have no forces",
    "horizontal": "state of the horizontal clearance: prior, estimated, rough, not_observable or withdrawn",
    "vertical": "state of the vertical clearance: prior, estimated, rough, not_observable or withdrawn",
    "pads": "state of the intervals of the pads: prior, estimated, rough, not_observable or withdrawn",
    "model": "agreement of the model with the measurements: ok or suspect",
    "sensor": "plausibility of the measured motion: ok or suspect",
    "follow": "off, or the source of the parameters of the model: prior or estimate",
    **{f"publishers_{topic}": "number of publishers that are connected to the node" for topic in TOPICS},
}

#: Keys of the part `source`, with their descriptions. Only a twin with an OPC UA server has this part.
SOURCE_KEYS: Final[dict[str, str]] = {
    "server": "address of the server",
    "connected": "whether the subscription exists",
    "publishing_ms": "interval of messages that the server grants [ms]",
    "sampling_ms": "interval of samples that the server grants [ms]",
    "queue": "length of the queue of a node that the server grants",
    "values": "values that were received",
    "bad": "values that were not used because of a bad status",
    "uncertain": "values that were not used because of an uncertain status",
    "not_numbers": "values that were not used because they are not numbers",
    "unstamped": "values that were not used because they have no stamp",
    "notifications_lost": "messages of the server that are missing",
    "overflows": "values before which the queue of the server overflowed",
    "breaks": "broken connections",
    "breaks_filled": "broken connections whose missing values were read from the history",
    "values_filled": "values that were read from the history",
    "history_strays": "values of the history from other times than requested",
    "unfilled_s": "time without values [s]",
    "no_history": "reason why the history cannot be read",
}


def keys_text() -> str:
    """Return a YAML text that describes the keys of `status` and of each part of `/diagnostics`."""
    lines = ["# Keys of `status` and of the parts of /diagnostics."]
    for part, keys in {"status": STATUS_KEYS, **KEYS, "source": SOURCE_KEYS}.items():
        lines += [f"{part}:", *(f'  {key}: "{text}"' for key, text in keys.items())]
    return "\n".join(lines) + "\n"


_LEVELS: Final = {
    StreamState.WAITING: OK,
    StreamState.RUNNING: OK,
    StreamState.STALE: WARN,
    StreamState.ENDED: ERROR,
    StreamState.FAILED: ERROR,
}


def summary(lifecycle: str, reason: str, runtime: Runtime | None, preparing: bool = False) -> Part:
    """Return the level, the message and the values of `status`."""
    values = dict.fromkeys(STATUS_KEYS, "")
    values["lifecycle"] = lifecycle
    if runtime is None:
        return (
            (ERROR if reason else OK),
            reason or (f"{lifecycle}, preparing the solver" if preparing else lifecycle),
            values,
        )
    state = runtime.driver.state
    values["scene"] = runtime.settings.scene
    values["stream"] = state.name.lower()
    stale = ["excitation"] if state in (StreamState.STALE, StreamState.ENDED) else []
    stale += runtime.inputs.silent()
    values["stale_inputs"] = ",".join(stale)
    values["clock"] = runtime.clock
    values["recorder"] = runtime.recorder_state
    values |= dict.fromkeys(("horizontal", "vertical", "pads"), "prior")
    estimation = runtime.estimation
    if estimation is not None:
        values |= {name: state.value for name, state in estimation.states.items()} | estimation.trust
    follower = runtime.follower
    values["follow"] = "off" if follower is None else "prior" if follower.estimate is None else "estimate"
    values |= {f"publishers_{topic}": str(count) for topic, count in runtime.inputs.publishers.items()}
    if lifecycle != "active":
        return OK, lifecycle, values
    level = _LEVELS[state]
    values["solver_failures"] = str(runtime.driver.failed.count)
    texts = [state.value, *failures(runtime)]
    others, keeper = ", ".join(runtime.inputs.other_senders()), runtime.wear_keeper
    silent = ", ".join(runtime.inputs.silent())
    troubles = [
        (ERROR, runtime.unsteady, "the stamps jump repeatedly: samples are dropped"),
        (ERROR, values["recorder"] == "trouble", "the recording has lost data or has stopped"),
        (ERROR, keeper, keeper.error if keeper else ""),
        (WARN, estimation, estimation.worker.error if estimation else ""),
        (WARN, estimation, "; ".join(estimation.reasons) if estimation else ""),
        (WARN, runtime.reduced, "the twins were too slow: measured poses no longer correct the motion"),
        (OK, runtime.clock == "paused", "/clock is paused"),
        (WARN, runtime.without_samples, "no sample has arrived"),
        (WARN, runtime.without_clock, "use_sim_time is set and no message has arrived on /clock"),
        (WARN, others, f"another publisher of {others} is also sending, and is not followed"),
        (WARN, runtime.others_publish, "another node also publishes contact_forces: is it a second twin?"),
        (WARN, silent, f"silent: {silent}"),
    ]
    for trouble_level, is_present, text in troubles:
        if is_present and text:
            level = max(level, trouble_level)
            texts.append(text)
    return level, "; ".join(texts), values


def failures(runtime: Runtime) -> list[str]:
    """Return a list with one text about the failed advances of the model, or an empty list without failures."""
    failed = runtime.driver.failed
    if not failed.count:
        return []
    since, until = runtime.time_text(failed.since_ns), runtime.time_text(failed.until_ns)
    begun = f"{failed.count} advances failed, without forces" + (
        f", in {failed.stretches} stretches, the newest" if failed.stretches > 1 else ""
    )
    if failed.lasts:
        return [f"{begun} since {since}: {failed.reason}"]
    whence = "was set to the initial position, with its wear" if failed.restarts else "continued from its last position"
    return [f"{begun} from {since} to {until}: {failed.reason}; then the head {whence}"]


class Health:
    """Parts of `/diagnostics`, with a warning for each counter that has grown since the previous report."""

    def __init__(self) -> None:
        self._before: dict[str, int] = {}

    def parts(self, lifecycle: str, reason: str, runtime: Runtime | None, now_ns: int) -> dict[str, Part]:
        """Return all parts by name; `now_ns` is the time of the monotonic clock [ns]."""
        parts = {"state": self.state(lifecycle, reason, runtime, now_ns)}
        if runtime is not None:
            parts["input"] = self.input(runtime)
            parts["output"] = self.output(runtime)
            parts["estimate"] = self.estimate(runtime)
            parts["follow"] = self.follow(runtime)
            parts["recorder"] = self.recorder(runtime)
        return parts

    def state(self, lifecycle: str, reason: str, runtime: Runtime | None, now_ns: int) -> Part:
        """Return the part `state` about the lifecycle, the stream of samples, and the solver."""
        level, message, _ = summary(lifecycle, reason, runtime)
        if runtime is not None and self._grown({"solver_failures": runtime.driver.failed.count}, ("solver_failures",)):
            level, message = ERROR, "; ".join(failures(runtime))
        values = dict.fromkeys(KEYS["state"], "")
        values |= {"lifecycle": lifecycle, "reason": reason}
        if runtime is not None:
            driver = runtime.driver
            values |= {
                "stream": driver.state.value,
                "reason": driver.failed.reason,
                "scene": runtime.settings.scene,
                "compile_s": f"{runtime.compile_s:.3f}",
                "model_time_s": f"{driver.real_time.model_s:.3f}",
                "real_time_factor": f"{driver.real_time.recent(now_ns):.4f}",
                "real_time_factor_mean": f"{driver.real_time.mean():.4f}",
                "solver_failures": str(driver.failed.count),
                "coarse_advances": str(driver.session.twin.bounded),
                "error_estimate_m": f"{driver.session.pop_error_estimate():.3g}",
                "resets": str(driver.resets),
            }
            keeper = runtime.wear_keeper
            if keeper is not None:
                values |= {"wear_saved": str(keeper.folder), "wear_error": keeper.error}
                if keeper.error:
                    level, message = ERROR, keeper.error
        return level, message, values

    def input(self, runtime: Runtime) -> Part:
        """Return the part `input` about the samples that arrived, were used, and were dropped."""
        counted = counters(runtime.driver)
        inputs, residual, age_s = runtime.inputs, runtime.residual(), runtime.age_s(runtime.driver.newest_ns)
        peak, wait_s = inputs.pop_queue_peak()
        values = {key: str(counted[key]) for key in KEYS["input"] if key in counted} | {
            "source": runtime.settings.excitation_source,
            "silent_s": f"{runtime.driver.silences.total_ns * 1e-9:.3f}" if counted["silences"] else "0",
            "newest_sample_age_s": "" if age_s is None else f"{age_s:.3f}",
            "samples_lost": str(inputs.senders.lost),
            "samples_not_followed": str(inputs.senders.ignored),
            "queue_peak": str(peak),
            "queue_wait_ms": _ms(wait_s),
            "messages_lost": str(inputs.lost),
            "head_pose_residual": "" if residual is None else "{:.6g} {:.6g} {:.6g}".format(*residual),
            "refused_publishers": str(inputs.refused_publishers),
        }
        for topic, source in inputs.optional.items():
            intake: Intake = getattr(inputs, topic)
            values |= {
                f"{topic}_used": str(intake.used),
                f"{topic}_dropped": str(intake.arrived - intake.used),
                f"{topic}_implausible": str(intake.counts[Verdict.IMPLAUSIBLE]),
                f"{topic}_not_followed": str(source.ignored),
            }
        more = {
            "samples_lost": inputs.senders.lost,
            "samples_not_followed": inputs.senders.ignored,
            "messages_lost": inputs.lost,
            "refused_publishers": inputs.refused_publishers,
            **{f"{topic}_dropped": _refused(getattr(inputs, topic)) for topic in OPTIONAL},
            **{f"{topic}_not_followed": optional.ignored for topic, optional in inputs.optional.items()},
        }
        increased = self._grown({**counted, **more}, _TROUBLE)
        if peak > inputs.depth // 2:
            increased.insert(0, f"input queue at {peak} of {inputs.depth}")
        if runtime.driver.state in (StreamState.STALE, StreamState.ENDED):
            increased.insert(0, "excitation stale")
        if "dropped_unstamped" in increased or "dropped_unsteady" in increased:
            return ERROR, "; ".join(increased), values
        return (WARN if increased else OK), "; ".join(increased) or "no trouble since the last report", values

    def output(self, runtime: Runtime) -> Part:
        """Return the part `output` about the published messages, their latency and their age."""
        latency, age = runtime.publishing.latency, runtime.publishing.age
        values = {
            "published": str(runtime.publishing.published),
            "withheld": str(runtime.publishing.withheld),
            "held": str(runtime.publishing.held_publications),
            "corrected": str(runtime.publishing.corrected_publications),
            "latency_p50_ms": _ms(latency.quantile(0.5)),
            "latency_p99_ms": _ms(latency.quantile(0.99)),
            "latency_max_ms": _ms(latency.largest_s) if latency.count else "",
            "age_p50_ms": _ms(age.quantile(0.5)),
            "age_p99_ms": _ms(age.quantile(0.99)),
            "recent_latency_p99_ms": _ms(latency.recent(0.99)),
            "recent_age_p99_ms": _ms(age.recent(0.99)),
        }
        missed = self._note_periods(runtime, values)
        if self._grown({"withheld": runtime.publishing.withheld}, ("withheld",)):
            return ERROR, "withheld", values
        return (WARN if missed else OK), missed or "publishing", values

    def _note_periods(self, runtime: Runtime, values: dict[str, str]) -> str:
        """Add statistics of the publishing period to `values`, and return a warning about missed periods or ""."""
        keys = ("periods_missed", "period_mean_ms", "period_deviation_ms", "period_max_ms")
        values |= dict.fromkeys(keys, "")
        if runtime.periods is None:
            return ""
        missed, before = runtime.periods.missed, self._before.get("periods_missed", 0)
        self._before["periods_missed"] = missed
        values |= zip(keys, (str(missed), *map(_ms, runtime.periods.recent())), strict=True)
        new = missed - before
        return f"{new} periods were missed since the last report" if 0 < runtime.settings.missed_periods <= new else ""

    def estimate(self, runtime: Runtime) -> Part:
        """Return the part `estimate` about the estimates and their process."""
        values = dict.fromkeys(KEYS["estimate"], "")
        estimation = runtime.estimation
        if estimation is None:
            return OK, "not estimating", values
        age_s = runtime.age_s(estimation.end_ns)
        values |= {
            "ready": str(int(estimation.worker.ready)),
            "estimates": str(estimation.count),
            "skipped": str(estimation.skipped),
            "window_age_s": "" if age_s is None else f"{age_s:.3f}",
            "wall_s": f"{estimation.wall_s:.3f}" if estimation.count else "",
            "reasons": "; ".join(estimation.reasons),
            "restarts": str(estimation.restarts),
            "error": estimation.worker.error,
        }
        trouble = estimation.worker.error or values["reasons"]
        doing = "estimating" if estimation.worker.ready else "compiling the estimator"
        return (ERROR if estimation.worker.error else WARN if trouble else OK), trouble or doing, values

    def follow(self, runtime: Runtime) -> Part:
        """Return the part `follow` about the twins that follow the measurements."""
        follower, reduced = runtime.follower, runtime.reduced
        values = dict.fromkeys(KEYS["follow"], "")
        values["follow"] = "off" if follower is None else "full" if follower.steered else "parameters"
        if follower is None:
            return OK, "not following", values
        values |= {
            "source": "prior" if follower.estimate is None else "estimate",
            "members": str(follower.members),
            "members_lost": str(follower.lost),
            "poses_used": str(follower.poses.used),
            "poses_outlying": str(follower.poses.outlying),
            "poses_dropped": str(follower.poses.dropped + runtime.driver.session.poses_dropped),
            "late_waiting": str(runtime.driver.session.waiting),
            "taken_over": str(follower.drawn),
            "reduced": str(int(reduced)),
        }
        if reduced:
            return WARN, "the twins were too slow", values
        if follower.lost:
            return WARN, f"{follower.lost} of {follower.members} twins have left the range of the model", values
        return OK, "following", values

    def recorder(self, runtime: Runtime) -> Part:
        """Return the part `recorder` about the recording. Its level is ERROR if data were lost."""
        values = dict.fromkeys(KEYS["recorder"], "")
        if runtime.recording is None:
            return OK, "not recording", values
        counters = runtime.recording.recorder.counters
        values |= {
            "recording": str(runtime.recording.recorder.path),
            "written": str(counters.written),
            "queued": str(counters.queued),
            "lost": ", ".join(f"{topic}: {count}" for topic, count in sorted(counters.lost.items())),
            "marks": str(counters.marks),
            "marks_lost": str(counters.marks_lost),
            "error": counters.error or "",
        }
        if counters.error or counters.lost:
            return ERROR, counters.error or f"lost: {values['lost']}", values
        return OK, "recording", values

    def _grown(self, now: dict[str, int], keys: Iterable[str]) -> list[str]:
        increased = [key for key in keys if now[key] > self._before.get(key, 0)]
        self._before |= now
        return increased


#: Counters of the part `input` that cause a warning when they have grown since the last report.
_TROUBLE: Final = (
    "dropped_unstamped", "dropped_non_finite", "dropped_duplicate", "dropped_out_of_order", "dropped_late",
    "dropped_implausible", "dropped_unsteady", "dropped_stray", "dropped_malformed",
    "dropped_not_selected", "jumps_back", "jumps_forward", "samples_missing", "samples_lost",
    "samples_not_followed", "messages_lost", "refused_publishers", "travel_dropped", "travel_misplaced",
    "head_pose_dropped", "gaps_dropped", "travel_not_followed", "head_pose_not_followed", "gaps_not_followed",
)  # fmt: skip


def _refused(intake: Intake) -> int:
    away = intake.counts[Verdict.INACTIVE] + intake.counts[Verdict.NO_CLOCK]
    return intake.arrived - intake.used - away


def _ms(seconds: float) -> str:
    return "" if seconds != seconds else f"{seconds * 1e3:.3f}"
