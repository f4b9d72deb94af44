"""The files of an analysis: `report.html`, `analysis.json` and Parquet tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.durable import naming, whole_file
from plow_twin.stream.outputs import CLEARANCE_NAMES
from plow_twin.study.analysis.signals import signal_unit
from plow_twin.study.report import embedded_figure, write_html, write_json
from plow_twin.view.figures import date_text, legend_beside

if TYPE_CHECKING:
    from plow_twin.study.analysis.analyse import Analysis, Prediction

_MOST_POINTS: Final = 4000
LEFT_OUT: Final = "left out: no recording"


def write_report(analysis: Analysis, out: Path) -> None:
    """Write all files of an analysis into the folder `out`."""
    with naming(out):
        out.mkdir(parents=True, exist_ok=True)
        facts = analysis.facts()
        write_json(out / "analysis.json", facts)
        context = {
            "facts": facts,
            "parts": [facts, *facts["with"]],
            "pairs": PAIR_NAMES,
            "unit": signal_unit,
            "number": lambda value: "" if value is None else f"{value:.4g}",
            "picture": _picture(analysis),
        }
        write_html(out / "report.html", "analysis.html.j2", context)
        for number, prediction in enumerate(analysis.predictions):
            _write_tables(prediction, out, f"_{number}" if number else "")
        _write_measured(analysis, out)


def _write_tables(prediction: Prediction, out: Path, suffix: str) -> None:
    stamps, columns = prediction.series()
    if len(stamps):
        _write_table({"stamp_ns": stamps, **columns}, out / f"predicted{suffix}.parquet")
    times, values = prediction.clearance.series()
    if len(times):
        table = {"stamp_ns": times} | {name: values[:, index] for index, name in enumerate(CLEARANCE_NAMES)}
        _write_table(table, out / f"clearance{suffix}.parquet")
    if prediction.loads.face:
        rows = [(number, piece, force) for (number, piece), force in sorted(prediction.loads.face.items())]
        keys = ("pass", "position_m", "largest_force_n")
        face = {key: list(column) for key, column in zip(keys, zip(*rows, strict=True), strict=True)}
        _write_table(face, out / f"face{suffix}.parquet")
    if prediction.loads.slide_wear:
        places = sorted(prediction.loads.slide_wear)
        depth = np.array([prediction.loads.slide_wear[place] for place in places])
        where = {"backward": [bool(backward) for backward, _ in places], "position_m": [piece for _, piece in places]}
        worn = {name: depth[:, index] for index, name in enumerate(PAIR_NAMES)}
        _write_table({**where, **worn}, out / f"slide_wear{suffix}.parquet")


def _write_measured(analysis: Analysis, out: Path) -> None:
    import pyarrow as pa

    series = {name: signal.series() for name, signal in analysis.measured.signals.items()}
    if not series:
        return
    places = np.repeat(np.arange(len(series), dtype=np.int32), [len(stamps) for stamps, _ in series.values()])
    table = {
        "signal": pa.DictionaryArray.from_arrays(places, list(series)),
        "stamp_ns": np.concatenate([stamps for stamps, _ in series.values()]),
        "value": np.concatenate([rows[:, 0] for _, rows in series.values()]),
    }
    _write_table(table, out / "measured.parquet")


def _write_table(columns: Mapping[str, Any], path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    with whole_file(path) as stream:
        parquet.write_table(pa.table(columns), stream)


def _picture(analysis: Analysis) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 9), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    start = None
    for number, prediction in enumerate(analysis.predictions):
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
        if name in analysis.measured.signals and start is not None:
            stamps, rows = analysis.measured.signals[name].series()
            at, thin = (stamps - start) * 1e-9, max(1, len(stamps) // _MOST_POINTS)
            axis.plot(at[::thin], 1e3 * rows[::thin, 0], ".", ms=1.5, color="0.3", label="measured")
    for axis, text in zip(axes, ("x [mm]", "y [mm]", "θ [mrad]", "largest force [kN]"), strict=True):
        axis.set_ylabel(text)
        if axis.get_legend_handles_labels()[0]:
            legend_beside(axis)
    axes[3].set_xlabel("time since the first stamp [s]")
    axes[3].set_ylim(bottom=0.0)
    date = date_text(start)
    scene = Path(analysis.predictions[0].name).name
    figure.suptitle(f"{analysis.path.name}, scene {scene}" + (f", {date}" if date else ""))
    return embedded_figure(figure)


def write_table_of_runs(rows: list[dict[str, Any]], out: Path, left_out: Sequence[Path] = ()) -> None:
    """Write `runs.parquet`: a row for each recording, and a row with the reason for each folder that was left out."""
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
