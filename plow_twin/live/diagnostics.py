"""The `status` of a twin and the parts of its diagnostics, made from its counters."""

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

#: Keys of each part of `/diagnostics` and their meanings.
KEYS: Final[dict[str, dict[str, str]]] = {
    "state": {
        "lifecycle": "unconfigured, inactive, active or finalized",
        "stream": "state of the stream",
        "reason": "reason of a failed configure or of the last failed advance",
        "scene": "scene in use",
        "compile_s": "time of compiling or loading the solver [s]",
        "model_time_s": "model time since configure [s]",
        "real_time_factor": "model seconds per second",
        "real_time_factor_mean": "model seconds per second since the first advance",
        "solver_failures": "failed advances",
        "coarse_advances": "advances cut short by max_evaluations",
        "error_estimate_m": "largest estimated pose error of the coarse advances [m]",
        "resets": "resets of the model",
        "wear_saved": "folder that keeps the wear",
        "wear_error": "reason why the wear could not be saved",
    },
    "input": {
        "source": "excitation source",
        "samples_in": "samples that arrived",
        "samples_used": "samples to which the model was advanced",
        "rolled_back": "late samples among the samples used",
        "newest_sample_age_s": "the node's time minus the stamp of the newest sample used [s]",
        "samples_missing": "samples missing at expected_rate, by gaps in the stamps",
        "samples_lost": "samples of the followed publisher that never arrived, by its numbering",
        "samples_not_followed": "messages of publishers that are not followed",
        "queue_peak": "largest number of samples in the input queue",
        "queue_wait_ms": "longest wait in the input queue [ms]",
        "messages_lost": "messages of all inputs that never arrived",
        "dropped_non_finite": "a number is not finite",
        "dropped_unstamped": "the stamp is zero or negative",
        "dropped_duplicate": "the stamp is that of another sample",
        "dropped_out_of_order": "older than the newest sample by more than rollback_span",
        "dropped_late": "older than every state that is kept",
        "dropped_implausible": "beyond limit_force or another limit",
        "dropped_unsteady": "the stamps have jumped too often",
        "dropped_stray": "the stamp jumped, but the next stamp continued the stamps before the jump",
        "dropped_malformed": "names do not match the loads of the scene",
        "dropped_not_selected": "not the selected excitation source",
        "dropped_inactive": "the node was not active",
        "dropped_without_clock": "input_depth samples already waited for the first message on /clock",
        "jumps_back": "stamps that stepped by more than the parameter jump_back or jump_forward",
        "jumps_forward": "stamps that stepped by more than the parameter jump_back or jump_forward",
        "out_of_plane": "samples used in spite of components outside the plane",
        "holds": "advances under the hold policy",
        "silences": "silences longer than excitation_timeout and five times the previous interval, whether held or not",
        "silent_s": "total length of the counted silences [s]",
        "travel_used": "messages used",
        "travel_dropped": "messages dropped",
        "travel_misplaced": "speeds applied at the time reached, because their stamps are of another clock",
        "travel_implausible": "dropped: beyond the limits of the input",
        "travel_not_followed": "messages of publishers that are not followed",
        "head_pose_used": "messages used",
        "head_pose_dropped": "messages dropped",
        "head_pose_implausible": "dropped: beyond the limits of the input",
        "head_pose_not_followed": "messages of publishers that are not followed",
        "gaps_used": "messages used",
        "gaps_dropped": "messages dropped",
        "gaps_implausible": "dropped: beyond the limits of the input",
        "gaps_not_followed": "messages of publishers that are not followed",
        "head_pose_residual": "model minus newest measured pose: x, y [m], theta [rad]",
        "refused_publishers": "publishers that cannot connect because of type or quality of service",
    },
    "output": {
        "published": "messages on contact_forces",
        "withheld": "messages withheld, because a number was not finite",
        "held": "published messages computed without a sample",
        "corrected": "published messages that correct earlier ones",
        "latency_p50_ms": "time from the reception of a sample to its forces: median, 99 %, largest [ms]",
        "latency_p99_ms": "time from the reception of a sample to its forces: median, 99 %, largest [ms]",
        "latency_max_ms": "time from the reception of a sample to its forces: median, 99 %, largest [ms]",
        "age_p50_ms": "system time minus stamp when published: median, 99 % [ms]; empty under use_sim_time",
        "age_p99_ms": "system time minus stamp when published: median, 99 % [ms]; empty under use_sim_time",
        "recent_latency_p99_ms": "the 99 % points since the last report [ms]",
        "recent_age_p99_ms": "the 99 % points since the last report [ms]",
        "periods_missed": "missed periods of publish_rate or step_rate",
        "period_mean_ms": "mean, standard deviation and largest value of the period [ms]",
        "period_deviation_ms": "mean, standard deviation and largest value of the period [ms]",
        "period_max_ms": "mean, standard deviation and largest value of the period [ms]",
    },
    "estimate": {
        "ready": "1 once the estimator is compiled; until then data wait",
        "estimates": "estimates since configure",
        "skipped": "windows skipped for a newer one: the machine is too slow for estimate_interval",
        "window_age_s": "the node's time minus the end of the newest window [s]",
        "wall_s": "time that the newest estimate took [s]",
        "reasons": "reasons why model or sensor is suspect",
        "error": "reason why the estimation has ended",
    },
    "follow": {
        "follow": "off, parameters or full",
        "source": "source of the model's numbers: prior or estimate",
        "members": "twins that are advanced",
        "members_lost": "twins that have left the model's range since the last pose",
        "poses_used": "measured poses that have moved the twins",
        "poses_outlying": "poses left out as too far from their predictions",
        "poses_dropped": "poses dropped: over an hour ahead of the load, or too many waiting",
        "taken_over": "redraws of the twins after an estimate, its withdrawal or a change of the machine",
        "reduced": "1 if the twins were too slow and only the parameters follow",
    },
    "recorder": {
        "recording": "file being written",
        "written": "items in the file",
        "queued": "items waiting",
        "lost": "items lost, by topic",
        "marks": "rings written",
        "marks_lost": "rings that could not be written",
        "error": "reason of the trouble",
    },
}

#: Keys of `status` and their meanings.
STATUS_KEYS: Final[dict[str, str]] = {
    "lifecycle": "unconfigured, inactive, active or finalized",
    "stream": "waiting, running, stale, ended or failed",
    "stale_inputs": "silent inputs, separated by commas",
    "clock": "running; under use_sim_time also waiting (for /clock) or paused",
    "recorder": "off, recording, or trouble (items were lost, or the recording has stopped)",
    "solver_failures": "failed advances: their samples have no forces",
    "horizontal": "state of the interval: prior, estimated, rough, not_observable or withdrawn",
    "vertical": "state of the interval: prior, estimated, rough, not_observable or withdrawn",
    "pads": "state of the interval: prior, estimated, rough, not_observable or withdrawn",
    "model": "agreement with the measurements: ok or suspect",
    "sensor": "agreement with the measurements: ok or suspect",
    "follow": "off, or the source of the twin's numbers: prior or estimate",
    **{f"publishers_{topic}": "number of publishers that the node is connected to" for topic in TOPICS},
}

#: Keys of the part `source`, which a connection to an OPC UA server adds, and their meanings.
SOURCE_KEYS: Final[dict[str, str]] = {
    "server": "address",
    "connected": "whether the subscription exists",
    "publishing_ms": "granted interval of messages [ms]",
    "sampling_ms": "granted interval of samples [ms]",
    "queue": "granted length of the queue of a node",
    "values": "values received",
    "bad": "values with a bad status, not used",
    "uncertain": "values with an uncertain status, not used",
    "not_numbers": "values that are not numbers, not used",
    "unstamped": "values without a stamp, not used",
    "notifications_lost": "missing messages",
    "overflows": "values before which the server's queue overflowed",
    "breaks": "broken connections",
    "breaks_filled": "breaks filled by the history",
    "values_filled": "values from the history",
    "history_strays": "values of the history from other times than requested",
    "unfilled_s": "time without values [s]",
    "no_history": "reason why the history cannot be read",
}


def keys_text() -> str:
    """Return the meaning of every key of `status` and of each part of `/diagnostics`, as YAML."""
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
    """Return level, message and values of `status`."""
    values = dict.fromkeys(STATUS_KEYS, "")
    values["lifecycle"] = lifecycle
    if runtime is None:
        return (
            (ERROR if reason else OK),
            reason or (f"{lifecycle}, preparing the solver" if preparing else lifecycle),
            values,
        )
    state = runtime.driver.state
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
    said = [state.value, *failures(runtime)]
    others, keeper = ", ".join(runtime.inputs.other_senders()), runtime.wear_keeper
    silent = ", ".join(runtime.inputs.silent())
    troubles = [
        (ERROR, runtime.unsteady, "the stamps jump again and again: samples are dropped"),
        (ERROR, values["recorder"] == "trouble", "the recording has lost data or has stopped"),
        (ERROR, keeper, keeper.error if keeper else ""),
        (WARN, estimation, estimation.worker.error if estimation else ""),
        (WARN, estimation, "; ".join(estimation.reasons) if estimation else ""),
        (WARN, runtime.reduced, "the following twins did not keep up: only the parameters follow"),
        (OK, runtime.clock == "paused", "/clock is paused"),
        (WARN, runtime.without_clock, "use_sim_time is set and nothing has come on /clock"),
        (WARN, others, f"another publisher of {others} sends too and is not followed"),
        (WARN, runtime.others_publish, "another node publishes contact_forces under this name too: a second twin?"),
        (WARN, silent, f"silent: {silent}"),
    ]
    for trouble_level, there, text in troubles:
        if there and text:
            level = max(level, trouble_level)
            said.append(text)
    return level, "; ".join(said), values


def failures(runtime: Runtime) -> list[str]:
    """Describe the failed advances of the model, and how it continued."""
    failed = runtime.driver.failed
    if not failed.count:
        return []
    since, until = runtime.time_text(failed.since_ns), runtime.time_text(failed.until_ns)
    begun = f"{failed.count} advances failed, without forces" + (
        f", in {failed.stretches} stretches, the newest" if failed.stretches > 1 else ""
    )
    if failed.lasts:
        return [f"{begun} since {since}: {failed.reason}"]
    whence = "began again in the initial position, with its wear" if failed.restarts else "went on from where it was"
    return [f"{begun} from {since} to {until}: {failed.reason}; then the head {whence}"]


class Health:
    """The parts of `/diagnostics`; it keeps the last report's counters, from which it computes what is new."""

    def __init__(self) -> None:
        self._before: dict[str, int] = {}

    def parts(self, lifecycle: str, reason: str, runtime: Runtime | None, now_ns: int) -> dict[str, Part]:
        """Return all parts by name; `now_ns` is a steady time."""
        parts = {"state": self.state(lifecycle, reason, runtime, now_ns)}
        if runtime is not None:
            parts["input"] = self.input(runtime)
            parts["output"] = self.output(runtime)
            parts["estimate"] = self.estimate(runtime)
            parts["follow"] = self.follow(runtime)
            parts["recorder"] = self.recorder(runtime)
        return parts

    def state(self, lifecycle: str, reason: str, runtime: Runtime | None, now_ns: int) -> Part:
        """Return the part `state`: the lifecycle, the stream of samples, and the solver."""
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
        """Return the part `input`: samples arrived, used and dropped."""
        counted = counters(runtime.driver)
        inputs, residual, age_s = runtime.inputs, runtime.residual(), runtime.newest_sample_age_s()
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
        for topic, one in inputs.optional.items():
            intake: Intake = getattr(inputs, topic)
            values |= {
                f"{topic}_used": str(intake.used),
                f"{topic}_dropped": str(intake.arrived - intake.used),
                f"{topic}_implausible": str(intake.counts[Verdict.IMPLAUSIBLE]),
                f"{topic}_not_followed": str(one.ignored),
            }
        more = {
            "samples_lost": inputs.senders.lost,
            "samples_not_followed": inputs.senders.ignored,
            "messages_lost": inputs.lost,
            **{f"{topic}_dropped": _refused(getattr(inputs, topic)) for topic in OPTIONAL},
            **{f"{topic}_not_followed": one.ignored for topic, one in inputs.optional.items()},
        }
        grown = self._grown({**counted, **more}, _TROUBLE)
        if peak > inputs.depth // 2:
            grown.insert(0, f"input queue at {peak} of {inputs.depth}")
        if runtime.driver.state in (StreamState.STALE, StreamState.ENDED):
            grown.insert(0, "excitation stale")
        if "dropped_unstamped" in grown or "dropped_unsteady" in grown:
            return ERROR, "; ".join(grown), values
        return (WARN if grown else OK), "; ".join(grown) or "no trouble since the last report", values

    def output(self, runtime: Runtime) -> Part:
        """Return the part `output`: the published messages, their latency and their age."""
        latency, age = runtime.publishing.latency, runtime.publishing.age
        values = {
            "published": str(runtime.publishing.published),
            "withheld": str(runtime.publishing.withheld),
            "held": str(runtime.publishing.held_frames),
            "corrected": str(runtime.publishing.corrected_frames),
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
        """Add the statistics of the loop's periods to `values`; return the fault found."""
        keys = ("periods_missed", "period_mean_ms", "period_deviation_ms", "period_max_ms")
        values |= dict.fromkeys(keys, "")
        if runtime.periods is None:
            return ""
        missed, before = runtime.periods.missed, self._before.get("periods_missed", 0)
        self._before["periods_missed"] = missed
        values |= zip(keys, (str(missed), *map(_ms, runtime.periods.recent())), strict=True)
        new = missed - before
        return f"{new} periods left out since the last report" if 0 < runtime.settings.missed_periods <= new else ""

    def estimate(self, runtime: Runtime) -> Part:
        """Return the part `estimate`."""
        values = dict.fromkeys(KEYS["estimate"], "")
        found = runtime.estimation
        if found is None:
            return OK, "not estimating", values
        age_s = runtime.estimate_age_s()
        values |= {
            "ready": str(int(found.worker.ready)),
            "estimates": str(found.count),
            "skipped": str(found.skipped),
            "window_age_s": "" if age_s is None else f"{age_s:.3f}",
            "wall_s": f"{found.wall_s:.3f}" if found.count else "",
            "reasons": "; ".join(found.reasons),
            "error": found.worker.error,
        }
        trouble = found.worker.error or values["reasons"]
        doing = "estimating" if found.worker.ready else "compiling the estimator"
        return (ERROR if found.worker.error else WARN if trouble else OK), trouble or doing, values

    def follow(self, runtime: Runtime) -> Part:
        """Return the part `follow`: how the twin follows the machine."""
        follower, reduced = runtime.follower, runtime.reduced
        values = dict.fromkeys(KEYS["follow"], "")
        values["follow"] = "off" if follower is None else "full" if follower.steered else "parameters"
        if follower is None:
            return OK, "not following", values
        values |= {
            "source": "prior" if follower.estimate is None else "estimate",
            "members": str(follower.members),
            "members_lost": str(follower.lost),
            "poses_used": str(follower.poses_used),
            "poses_outlying": str(follower.poses_outlying),
            "poses_dropped": str(follower.poses_dropped + runtime.driver.session.poses_dropped),
            "taken_over": str(follower.drawn),
            "reduced": str(int(reduced)),
        }
        if reduced:
            return WARN, "the twins did not keep up", values
        if follower.lost:
            return WARN, f"{follower.lost} of {follower.members} twins have left the model's range", values
        return OK, "following", values

    def recorder(self, runtime: Runtime) -> Part:
        """Return the part `recorder`; lost data are an error."""
        values = dict.fromkeys(KEYS["recorder"], "")
        if runtime.recording is None:
            return OK, "not recording", values
        found = runtime.recording.recorder.counters
        values |= {
            "recording": str(runtime.recording.recorder.path),
            "written": str(found.written),
            "queued": str(found.queued),
            "lost": ", ".join(f"{topic}: {count}" for topic, count in sorted(found.lost.items())),
            "marks": str(found.marks),
            "marks_lost": str(found.marks_lost),
            "error": found.error or "",
        }
        if found.error or found.lost:
            return ERROR, found.error or f"lost: {values['lost']}", values
        return OK, "recording", values

    def _grown(self, now: dict[str, int], keys: Iterable[str]) -> list[str]:
        grown = [key for key in keys if now[key] > self._before.get(key, 0)]
        self._before |= now
        return grown


#: Counters of the part `input` whose growth is a warning.
_TROUBLE: Final = (
    "dropped_unstamped",
    "dropped_non_finite",
    "dropped_duplicate",
    "dropped_out_of_order",
    "dropped_late",
    "dropped_implausible",
    "dropped_unsteady",
    "dropped_stray",
    "rolled_back",
    "dropped_malformed",
    "dropped_not_selected",
    "jumps_back",
    "jumps_forward",
    "out_of_plane",
    "samples_missing",
    "samples_lost",
    "samples_not_followed",
    "messages_lost",
    "travel_dropped",
    "travel_misplaced",
    "head_pose_dropped",
    "gaps_dropped",
    "travel_not_followed",
    "head_pose_not_followed",
    "gaps_not_followed",
)


def _refused(intake: Intake) -> int:
    away = intake.counts[Verdict.INACTIVE] + intake.counts[Verdict.NO_CLOCK]
    return intake.arrived - intake.used - away


def _ms(seconds: float) -> str:
    return "" if seconds != seconds else f"{seconds * 1e3:.3f}"
