"""A run as one self-contained HTML file with a summary, a picture, curves and tables."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.record.alarms import ALARMS, alarm_texts, alarms_of
from plow_twin.record.messages import DiagnosticStatus
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.recording import Recording, read_recording
from plow_twin.record.times import time_text
from plow_twin.stream.journal import Estimated, Failed, Mark, Reset
from plow_twin.stream.outputs import CLEARANCE_NAMES, PAD_NAMES
from plow_twin.study.report import embedded_figure, write_html
from plow_twin.view.envelope import Envelope
from plow_twin.view.picture import run_figure
from plow_twin.view.run_curves import RunCurves

Array = NDArray[np.float64]

#: Largest number of rows in a table. Further rows are only counted.
_MOST_ROWS: Final = 200
_PADS: Final = np.array([CLEARANCE_NAMES.index(name) for name in PAD_NAMES])
_LOADS: Final = ("Fx", "Fy", "M")


def write_run_page(path: Path, out: Path) -> tuple[FileStatus, dict[str, int], int]:
    """Write the page of a run. Return the status of the recording, its losses, and the number of failed advances.

    Raise `RecordingError` if the file is not a recording, or has no rows to draw.
    """
    reader = RunReader(path)
    curves = RunCurves.of(reader)
    picture = embedded_figure(run_figure(reader, curves))
    lost = {**reader.lost, **reader.lost_parts}
    log = _Log.of(RunReader(path))
    context = {
        "title": "/".join(reader.path.absolute().parent.parts[-2:]),
        "summary": _summary(reader, curves, log),
        "picture": picture,
        "pads": _by_pad(read_recording(path)),
        "lost": lost,
        "silences": curves.silences,
        "log": log,
        "most_rows": _MOST_ROWS,
        "plots": _plots(reader, curves),
        "uplot": _uplot("uPlot.iife.min.js"),
        "uplot_style": _uplot("uPlot.min.css"),
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    write_html(out, "run.html.j2", context)
    return reader.status, lost, curves.failed


def _uplot(name: str) -> str:
    return files("plow_twin").joinpath("dashboard", "page", name).read_text(encoding="utf-8")


@dataclass
class _Log:
    samples: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    alarms: list[str] = field(default_factory=list)
    estimates: list[dict[str, str]] = field(default_factory=list)
    events: list[tuple[str, str]] = field(default_factory=list)

    @classmethod
    def of(cls, reader: RunReader) -> _Log:
        log, alarms = cls(), reader.header.topic(ALARMS)
        for batch in reader.batches():
            stamps = batch.entries.samples()[0]
            log.samples += len(stamps)
            if len(stamps):
                log.first_ns = int(stamps[0]) if log.first_ns is None else log.first_ns
                log.last_ns = int(stamps[-1])
            for _, entry in sorted(batch.entries.others.items()):
                log._entry(entry)
            for message in (record.message() for part in batch.outputs for record in part.on((alarms,))):
                if isinstance(message, DiagnosticStatus):
                    log.alarms += [text for text in alarm_texts(dict(message.values)) if text not in log.alarms]
        return log

    def _entry(self, entry: Any) -> None:
        match entry:
            case Estimated(end_ns=end_ns, result=result):
                self.estimates.append(_estimate_row(end_ns, json.loads(result)))
            case Mark(stamp_ns, text):
                self.events.append((time_text(stamp_ns), text if text.startswith("alarm: ") else f"mark: {text}"))
            case Reset(stamp_ns, reason):
                self.events.append((time_text(stamp_ns), f"reset: {reason}"))
            case Failed(stamp_ns, _, advances, reason):
                self.events.append((time_text(stamp_ns), f"{advances} advances failed: {reason}"))


def _estimate_row(end_ns: int, facts: dict[str, Any]) -> dict[str, str]:
    row = {"until": time_text(end_ns)}
    for name in ("horizontal", "vertical"):
        clearance_facts = facts[name]
        low, high = 1e3 * clearance_facts["p05_m"], 1e3 * clearance_facts["p95_m"]
        state = clearance_facts["state"].replace("_", " ")
        row[f"{name} [mm]"] = f"{1e3 * clearance_facts['mean_m']:.2f} ({low:.2f} to {high:.2f}), {state}"
    reasons = "; ".join(facts["reasons"])
    row["trust"] = f"model {facts['model']}, sensor {facts['sensor']}" + (f": {reasons}" if reasons else "")
    return row


def _summary(reader: RunReader, curves: RunCurves, log: _Log) -> dict[str, str]:
    header, scene = reader.header, reader.header.scene(reader.path)
    span = "" if log.first_ns is None or log.last_ns is None else f"{(log.last_ns - log.first_ns) * 1e-9:.3f} s"
    clearance, contact = scene.clearance, scene.contact
    return {
        "recording": reader.path.name,
        "ended": reader.status.value,
        "first sample": "none" if log.first_ns is None else time_text(log.first_ns),
        "span of the samples": span or "none",
        "samples used": str(log.samples),
        "failed advances": str(curves.failed),
        "load": header.excitation_source,
        "scene": str(header.parameters.get("scene") or "that of the recording"),
        "head": f"{scene.head.mass_kg:g} kg",
        "horizontal clearance of the scene": f"{1e3 * clearance.horizontal_m:g} mm",
        "vertical clearance of the scene": f"{1e3 * clearance.vertical_m:g} mm",
        "contact": f"{contact.law.replace('_', ' ')}, stiffness {contact.stiffness:.4g}, exponent {contact.exponent:g}",
        "plow_twin": header.package_version,
        "run": header.run_id,
    }


def _by_pad(recording: Recording) -> list[dict[str, str]]:
    largest, impulse, touches = np.zeros(PAIR_COUNT), np.zeros(PAIR_COUNT), np.zeros(PAIR_COUNT)
    in_contact, rows, before = np.zeros(PAIR_COUNT), 0, None
    wear: Array | None = None
    for found in recording.batches("contact_forces", "contact_peaks", "clearance"):
        if "contact_peaks" in found:
            total, moved, peak = np.split(found["contact_peaks"].values, 3, axis=1)
            first = total[:1] if before is None else before
            touches += np.clip(np.diff(np.concatenate((first, total)), axis=0), 0.0, None).sum(axis=0)
            impulse += moved.sum(axis=0)
            largest, before = np.maximum(largest, peak.max(axis=0)), total[-1:]
        if "contact_forces" in found:
            force = found["contact_forces"].values[:, 2 * PAIR_COUNT :]
            in_contact += (force > 0.0).sum(axis=0)
            rows += len(force)
        if "clearance" in found:
            wear = found["clearance"].values[-1, _PADS]
    return [
        {
            "pad": name,
            "largest force [kN]": f"{largest[pair] / 1e3:.1f}",
            "touches": f"{touches[pair]:.0f}",
            "impulse [kN s]": f"{impulse[pair] / 1e3:.2f}",
            "samples in contact [%]": f"{100.0 * in_contact[pair] / rows:.1f}" if rows else "",
            "wear at the end [µm]": "" if wear is None else f"{1e6 * wear[pair]:.2f}",
        }
        for pair, name in enumerate(PAIR_NAMES)
    ]


def _plots(reader: RunReader, curves: RunCurves) -> list[dict[str, Any]]:
    alarms = alarms_of(reader.header.parameters).alarms
    force, clearance = alarms["force"].thresholds, alarms["clearance"].thresholds
    directions = ("horizontal", "vertical")
    charts: list[dict[str, Any]] = [
        {
            "title": "Largest force of each pad [kN]",
            "names": list(PAIR_NAMES),
            "bands": [],
            "limits": [value / 1e3 for value in (force.warn, force.error)],
            "data": _columns(curves.force, [(pair, 1) for pair in range(PAIR_COUNT)]),
        },
        {
            "title": "Load, least and largest [kN, kN m]",
            "names": [f"{name} {side}" for name in _LOADS for side in ("least", "largest")],
            "bands": [[2 * load + 2, 2 * load + 1] for load in range(3)],
            "limits": [],
            "data": _columns(curves.load, [(load, side) for load in range(3) for side in (0, 1)]),
        },
        {
            "title": "Clearance with its 90 % interval [mm]",
            "names": [f"{direction}{point}" for direction in directions for point in ("", " 5 %", " 95 %")],
            "bands": [[3, 2], [6, 5]],
            "limits": [value * 1e3 for value in (clearance.warn, clearance.error)],
            "data": _columns(curves.clearance, [(column, int(column % 3 != 1)) for column in range(6)]),
        },
    ]
    return [plot for plot in charts if plot["data"][0]]


def _columns(rows: Envelope, chosen: list[tuple[int, int]]) -> list[list[float | None]]:
    """Return a column of times, and a column of values for each item (column, side) of `chosen`.

    Side 0 is the least value of an interval, side 1 the largest value. None interrupts a curve.
    """
    times: Array | None = None
    columns: list[list[float | None]] = []
    order = np.zeros(0, np.int64)
    for column, side in chosen:
        at, *sides = rows.bands(column)
        if times is None:
            gaps = np.flatnonzero(np.isnan(at))
            at[gaps] = 0.5 * (at[gaps - 1] + at[gaps + 1])
            times, order = at, np.argsort(at, kind="stable")
        columns.append([None if np.isnan(value) else round(value, 6) for value in sides[side][order].tolist()])
    assert times is not None
    return [[round(value, 6) for value in times[order].tolist()], *columns]
