"""The result of an analysis as files: `report.html`, `analysis.json` and Parquet tables."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.durable import naming, whole_file, write_whole
from plow_twin.study.analysis.signals import signal_unit
from plow_twin.study.report import embedded_figure
from plow_twin.view.figures import date_text, legend_beside

if TYPE_CHECKING:
    from plow_twin.study.analysis.analyse import Analysis, Prediction

_MOST_POINTS: Final = 4000
#: Text in place of results for a folder without a recording.
LEFT_OUT: Final = "left out: no recording"

_PAGE: Final = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{{ facts.run }}</title>
<style>body{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:70em;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:1em 0}td,th{border:1px solid #ccc;padding:.25em .6em;text-align:right}
th:first-child,td:first-child,.long{text-align:left}img{max-width:100%}</style></head><body>
<h1>{{ facts.run }}</h1>
<p>{{ facts.kind }}; {{ facts.input.samples_used }} samples used, {{ "%.1f" | format(facts.loads.duration_s) }} s.
{% if facts.without_samples %}{{ facts.without_samples }}; there the load is interpolated linearly.{% endif %}
{% if facts.lost %}Lost: {{ facts.lost }}.{% endif %}
{% if facts.left_out %}Left out, not part of this recording: {{ facts.left_out | join(", ") }}.{% endif %}
{% if facts.skipped_topics %}Topics of unknown type: {{ facts.skipped_topics }}.{% endif %}</p>
{% for part in parts %}
<h2>Scene {{ part.scene }}</h2>
{% if part.signals %}<h3>Predicted minus measured</h3>
<table><tr><th>signal</th><th>n</th><th>bias</th><th>RMS</th><th>correlation [1]</th><th>lag [s]</th>
<th>RMS aligned</th><th>coherence [1]</th></tr>{% for name, s in part.signals.items() %}
<tr><td>{{ name }} [{{ unit(name) }}]</td><td>{{ s.n }}</td><td>{{ number(s.bias) }}</td><td>{{ number(s.rms) }}</td>
<td>{{ number(s.correlation) }}</td><td>{{ number(s.lag_s) }}</td><td>{{ number(s.rms_aligned) }}</td>
<td>{{ number(s.coherence) }}</td></tr>{% endfor %}</table>
{% else %}<p>Nothing was measured.</p>{% endif %}
{% if part.stretches %}<p>Resets divide the run into {{ part.stretches }} stretches; signals are of the
longest. Measured values of the others: {{ part.not_compared or "none" }}.</p>{% endif %}
{% if part.outside %}<p>Measured values outside the time of the load, not compared: {{ part.outside }}.</p>{% endif %}
<h3>Contacts</h3>
<table><tr><th>pair</th><th>impacts</th><th>largest force [kN]</th><th>impulse [kN s]</th><th>duty [%]</th></tr>
{% for name in pairs %}<tr><td>{{ name }}</td><td>{{ part.loads.impacts[name] }}</td>
<td>{{ "%.2f" | format(part.loads.largest_force_n[name] / 1e3) }}</td>
<td>{{ "%.3f" | format(part.loads.impulse_n_s[name] / 1e3) }}</td>
<td>{{ "%.2f" | format(100 * part.loads.duty[name]) }}</td></tr>{% endfor %}</table>
<h3>Passes of the face</h3>
<table><tr><th>pass</th><th>from [s]</th><th>to [s]</th><th>from [m]</th><th>to [m]</th><th>impacts</th>
<th>largest force [kN]</th><th>taken by contacts [kJ]</th></tr>{% for p in part.loads.passes %}
<tr><td>{{ loop.index }}</td><td>{{ "%.1f" | format(p.start_s) }}</td><td>{{ "%.1f" | format(p.end_s) }}</td>
<td>{{ "%.1f" | format(p.start_m | round(1) + 0) }}</td><td>{{ "%.1f" | format(p.end_m | round(1) + 0) }}</td>
<td>{{ p.impacts }}</td>
<td>{{ "%.2f" | format(p.largest_force_n / 1e3) }}</td><td>{{ "%.3f" | format(p.contact_loss_j / 1e3) }}</td>
</tr>{% endfor %}</table>
<h3>Rainflow counts of the contact force</h3>
<table><tr><th>pair</th><th>range up to [kN]: cycles</th></tr>{% for name, bins in part.loads.cycles.items() %}
<tr><td>{{ name }}</td><td class="long">
{% for b in bins %}{% if b.count %}{{ "%.1f" | format(b.range_n / 1e3) }}: {{ b.count }};
{% endif %}{% endfor %}</td></tr>{% endfor %}</table>
{% endfor %}
<h2>Course</h2><img alt="Pose and forces in time" src="{{ picture }}">
</body></html>
"""


def write_report(found: Analysis, out: Path) -> None:
    """Write all files of an analysis into the folder `out`; a disk error names the file."""
    with naming(out):
        _write_report(found, out)


def _write_report(found: Analysis, out: Path) -> None:
    from jinja2 import Environment

    out.mkdir(parents=True, exist_ok=True)
    facts = found.facts()
    write_whole(out / "analysis.json", json.dumps(facts, indent=2, allow_nan=False).encode())
    environment = Environment(autoescape=True)
    page = environment.from_string(_PAGE).render(
        facts=facts,
        parts=[facts, *facts["with"]],
        pairs=PAIR_NAMES,
        unit=signal_unit,
        number=lambda value: "" if value is None else f"{value:.4g}",
        picture=_picture(found),
    )
    write_whole(out / "report.html", page.encode())
    for number, prediction in enumerate(found.predictions):
        _write_tables(prediction, out, f"_{number}" if number else "")
    _write_measured(found, out)


def _write_tables(prediction: Prediction, out: Path, suffix: str) -> None:
    stamps, columns = prediction.series()
    if len(stamps):
        _write_table({"stamp_ns": stamps, **columns}, out / f"predicted{suffix}.parquet")
    times, values = prediction.clearance.series()
    if len(times):
        from plow_twin.stream.outputs import CLEARANCE_NAMES

        table = {"stamp_ns": times} | {name: values[:, index] for index, name in enumerate(CLEARANCE_NAMES)}
        _write_table(table, out / f"clearance{suffix}.parquet")
    if prediction.loads.face:
        rows = [(number, piece, force) for (number, piece), force in sorted(prediction.loads.face.items())]
        keys = ("pass", "position_m", "largest_force_n")
        face = {key: list(column) for key, column in zip(keys, zip(*rows, strict=True), strict=True)}
        _write_table(face, out / f"face{suffix}.parquet")
    if prediction.loads.slide_wear:
        from plow_twin.model.pairs import PAIR_NAMES

        places = sorted(prediction.loads.slide_wear)
        depth = np.array([prediction.loads.slide_wear[place] for place in places])
        where = {"backward": [bool(one) for one, _ in places], "position_m": [piece for _, piece in places]}
        worn = {name: depth[:, index] for index, name in enumerate(PAIR_NAMES)}
        _write_table({**where, **worn}, out / f"slide_wear{suffix}.parquet")


def _write_measured(found: Analysis, out: Path) -> None:
    import pyarrow as pa

    series = {name: signal.series() for name, signal in found.measured.signals.items()}
    if not series:
        return
    places = np.repeat(np.arange(len(series), dtype=np.int32), [len(stamps) for stamps, _ in series.values()])
    table = {
        "signal": pa.DictionaryArray.from_arrays(places, list(series)),
        "stamp_ns": np.concatenate([stamps for stamps, _ in series.values()]),
        "value": np.concatenate([values for _, values in series.values()]),
    }
    _write_table(table, out / "measured.parquet")


def _write_table(columns: Mapping[str, Any], path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    with whole_file(path) as stream:
        parquet.write_table(pa.table(columns), stream)


def _picture(found: Analysis) -> str:
    """Return measured and predicted pose and the largest force as an embedded PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 9), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    start = None
    for number, prediction in enumerate(found.predictions):
        stamps, columns = prediction.series()
        if not len(stamps):
            continue
        start = int(stamps[0]) if start is None else start
        thin = max(1, len(stamps) // _MOST_POINTS)
        times = (stamps - start) * 1e-9
        label = "predicted" if not number else f"with {Path(prediction.name).name}"
        for axis, name in zip(axes, ("x", "y", "theta"), strict=False):
            axis.plot(times[::thin], 1e3 * columns[name][::thin], lw=0.9, label=label)
        count = len(stamps) // thin * thin
        force = np.max([columns[f"force_{pair}"][:count] for pair in PAIR_NAMES], axis=0).reshape(-1, thin).max(axis=1)
        axes[3].plot(times[:count:thin], force / 1e3, lw=0.7, label=label)
    for axis, name in zip(axes, ("x", "y", "theta"), strict=False):
        if name in found.measured.signals and start is not None:
            stamps, values = found.measured.signals[name].series()
            at, thin = (stamps - start) * 1e-9, max(1, len(stamps) // _MOST_POINTS)
            axis.plot(at[::thin], 1e3 * values[::thin], ".", ms=1.5, color="0.3", label="measured")
    for axis, text in zip(axes, ("x [mm]", "y [mm]", "θ [mrad]", "largest force [kN]"), strict=True):
        axis.set_ylabel(text)
        if axis.get_legend_handles_labels()[0]:
            legend_beside(axis)
    axes[3].set_xlabel("time since the first stamp [s]")
    axes[3].set_ylim(bottom=0.0)
    date = date_text(start)
    scene = Path(found.predictions[0].name).name
    figure.suptitle(f"{found.path.name}, scene {scene}" + (f", {date}" if date else ""))
    return embedded_figure(figure)


def write_table_of_runs(rows: list[dict[str, Any]], out: Path, left_out: Sequence[Path] = ()) -> None:
    """Write `runs.parquet` with a row for each recording, and a row with the reason for each folder left out."""
    flat = []
    for facts in [*rows, *({"run": str(path), "error": LEFT_OUT} for path in left_out)]:
        lost = sum(facts["lost"].values()) if "lost" in facts else None
        row: dict[str, Any] = {"run": facts["run"], "error": facts.get("error"), "lost": lost}
        for name, signal in facts.get("signals", {}).items():
            row |= {f"{name}_{key}": value for key, value in signal.items()}
        loads = facts.get("loads", {})
        row |= {"impacts": sum(loads.get("impacts", {}).values()), "duration_s": loads.get("duration_s")}
        row["largest_force_n"] = max(loads.get("largest_force_n", {}).values(), default=None)
        flat.append(row)
    out.mkdir(parents=True, exist_ok=True)
    keys = list(dict.fromkeys(key for row in flat for key in row))
    _write_table({key: [row.get(key) for row in flat] for key in keys}, out / "runs.parquet")
