"""The picture of a recording: envelopes of long runs, clearances in mm, and annotations inside the axes."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from figure_checks import check_figure, kept_figures
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from record_support import BASE_NS, STEP_NS, paper_sample, record_run

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.messages import JointState
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.stream.journal import Entry, Estimated, Hold, SetModel
from plow_twin.view.envelope import Envelope
from plow_twin.view.picture import run_figure, to_png
from plow_twin.view.run_curves import RunCurves


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    return kept_figures(monkeypatch)


def test_the_band_of_an_hour_of_load_is_constant() -> None:
    envelope = Envelope(1)
    times = np.arange(72_000) / 20.0
    for part in np.array_split(times, 300):  # rows arrive in parts, as in the batches of a recording
        envelope.add(part, np.sin(2.0 * part)[:, None])
    at, least, largest = envelope.bands(0)
    assert 300 <= len(at) <= 700
    widths = np.diff(at)
    np.testing.assert_allclose(widths, widths[0])
    assert (largest[:-1] > 0.99).all() and (least[:-1] < -0.99).all()  # all bins but the last contain a whole period


@given(st.lists(st.integers(1, 40), min_size=1, max_size=12), st.integers(0, 2**31))
def test_an_envelope_keeps_extremes_and_gaps(sizes: list[int], seed: int) -> None:
    random = np.random.default_rng(seed)
    envelope = Envelope(2, most_rows=32, most_bins=8)
    parts = []
    for size in sizes:
        times, values = np.sort(random.uniform(-5.0, 100.0, size)), random.normal(size=(size, 2))
        for chosen in np.array_split(np.arange(size), 3):
            envelope.add(times[chosen], values[chosen])
        envelope.break_line()
        parts.append(values)
    everything = np.concatenate(parts)
    for column in range(2):
        at, least, largest = envelope.bands(column)
        assert np.nanmax(largest) == everything[:, column].max() and np.nanmin(least) == everything[:, column].min()
    assert np.isnan(at).sum() == len(sizes) - 1
    if len(everything) <= 32:
        assert len(at) == len(everything) + len(sizes) - 1


def test_estimates_and_changed_parameters_are_marked_and_not_drawn_as_wear(
    tmp_path: Path, figures: list[Figure]
) -> None:
    first = [paper_sample(index) for index in range(400)]
    stamp = BASE_NS + 400 * STEP_NS
    estimated = Estimated(BASE_NS, stamp - 100 * STEP_NS, 300, 30, (), (1e-3, 5e-4, 1.5e-3, 0.0, 0.0, 0.0), "{}")
    changed = SetModel(stamp + 100 * STEP_NS, '{"clearance.horizontal_m": 0.031}')
    entries: list[Entry] = [*first, estimated, *(paper_sample(index) for index in range(400, 500)), changed]
    entries += [paper_sample(index) for index in range(500, 900)]
    run = record_run(tmp_path / "run", entries)
    to_png(run.folder, tmp_path / "run.png")
    clearance = figures[0].axes[4]
    assert clearance.get_ylabel().endswith("[mm]")
    horizontal = np.asarray(clearance.lines[0].get_ydata(), float)
    # the change of the model ends the estimate
    np.testing.assert_allclose(np.unique(horizontal.round(6)), [25.0, 26.0, 31.0])
    marks = {text.get_text(): text.xy[0] for text in clearance.texts if isinstance(text, Annotation)}
    # the window of the estimate ended earlier, but the estimate is valid only from its arrival on
    assert marks == {"first estimate": pytest.approx(0.399), "parameters set": pytest.approx(0.5)}


def test_an_estimate_after_the_last_publication_ends_the_curves_of_the_clearances(
    tmp_path: Path, figures: list[Figure]
) -> None:
    found = {"mean_m": 26.5e-3, "p05_m": 26.3e-3, "p95_m": 26.8e-3, "state": "estimated"}
    result = json.dumps({"horizontal": found, "vertical": {**found, "state": "not_observable"}})
    stamp = BASE_NS + 400 * STEP_NS
    estimated = Estimated(BASE_NS, stamp, 400, 40, (), (1.5e-3, 1.3e-3, 1.8e-3, 0.0, 0.0, 0.0), result)
    run = record_run(tmp_path / "run", [*(paper_sample(index) for index in range(400)), estimated])
    to_png(run.folder, tmp_path / "run.png")
    horizontal, vertical = figures[0].axes[4].get_legend_handles_labels()[1][:2]
    assert horizontal == "horizontal, at the end\n26.50 mm (26.30 to 26.80),\nestimated"
    assert vertical == "vertical, at the end\n30.000 mm,\nnot observable"


def test_a_stretch_without_samples_is_shaded_and_crossed_by_no_line(tmp_path: Path, figures: list[Figure]) -> None:
    def held(first: int, last: int) -> list[Entry]:
        return [Hold(BASE_NS + index * STEP_NS) for index in range(first, last)]

    # late samples fill the second silence, so it is not shaded; the third silence lasts until the end
    entries: list[Entry] = [*map(paper_sample, range(200)), *held(200, 500), *map(paper_sample, range(500, 700))]
    entries += [*held(750, 751), *map(paper_sample, range(700, 900)), *held(900, 1000)]
    run = record_run(tmp_path / "run", entries, rollback_span_s=0.2)
    to_png(run.folder, tmp_path / "run.png")
    check_figure(figures[0])
    assert "grey: without samples" in figures[0].axes[4].get_xlabel()
    for axis in figures[0].axes[2:]:
        shades = [(shade.get_x(), shade.get_x() + shade.get_width()) for shade in axis.patches]
        assert [pytest.approx(shade) for shade in shades] == [(0.199, 0.5), (0.699, 0.7), (0.899, 0.999)]
    times, load = figures[0].axes[3].lines[0].get_data()
    gap = np.flatnonzero(np.isnan(load))[:2]
    np.testing.assert_allclose([times[gap - 1], times[gap + 1]], [[0.199, 0.699], [0.5, 0.7]])


def test_every_force_of_the_instant_shown_has_its_arrow_and_its_value_inside_the_axes(
    tmp_path: Path, figures: list[Figure]
) -> None:
    load = map(paper_sample, range(0, 3000, 50))  # the samples are so far apart that the peaks are between the stamps
    run = record_run(tmp_path / "run", load)
    to_png(run.folder, tmp_path / "run.png")
    check_figure(figures[0])
    reader = RunReader(run.folder)
    curves = RunCurves.of(reader)
    curves.held_s, curves.failed_s = [(0.1, 0.2)], [(0.3, 0.4)]
    curves.changes = [(0.5, "first estimate"), (0.501, "parameters set")]
    check_figure(whole := run_figure(reader, curves))
    assert [text.get_text() for text in whole.axes[4].texts] == ["first estimate, parameters set"]
    section = figures[0].axes[0]
    assert "to scale" in section.get_xlabel() and "head turned by" in section.get_title()
    values = [text for text in section.texts if text.get_text().endswith("kN")]
    of_run, at_stamp = (float(number) for number in re.findall(r"([\d.]+) kN", section.get_title()))
    assert max(float(text.get_text().split()[0]) for text in values) == pytest.approx(at_stamp, abs=0.51)
    peaks = max(max(m.effort) for topic, m in run.outputs if topic == "/contact_peaks" and isinstance(m, JointState))
    assert of_run == pytest.approx(peaks / 1e3, abs=0.051) and of_run > at_stamp  # the other views show the same peak
    assert 1 <= len(values) <= PAIR_COUNT
    x, y = sorted(section.get_xlim()), sorted(section.get_ylim())
    for text in values:
        at = text.get_position()
        assert x[0] < at[0] < x[1] and y[0] < at[1] < y[1] and math.isfinite(at[0])


def test_the_title_has_run_scene_and_date_and_thresholds_are_drawn(
    tmp_path: Path, figures: list[Figure], monkeypatch: pytest.MonkeyPatch
) -> None:
    alarms = {"alarm_force": [1.2e5, 1.5e5], "alarm_clearance": [0.031, 0.0], "scene": "paper"}
    run = record_run(tmp_path / "monday", map(paper_sample, range(300)), parameters=alarms)
    to_png(run.folder, tmp_path / "run.png")
    title = figures[0].get_suptitle()
    start = f"{tmp_path.name}/monday, scene paper, 20"
    assert title.startswith(start) and " UTC" in title
    reader = RunReader(run.folder)
    curves = RunCurves.of(reader)
    lost = dict.fromkeys(("journal", "/contact_forces", "/contact_peaks", "/head_state", "/clearance", "/status"), 1000)
    monkeypatch.setattr(RunReader, "lost", property(lambda _: lost))
    monkeypatch.setattr(RunReader, "lost_parts", property(lambda _: {"missing_parts": 2}))
    reader.status = FileStatus.STOPPED_EARLY
    check_figure(figure := run_figure(reader, curves))
    title, losses = figure.get_suptitle().split("\n")
    assert title.startswith(start) and title.endswith(FileStatus.STOPPED_EARLY.value)
    assert losses == "6000 messages lost on 6 topics, lost missing parts: 2"
    extent = figure._suptitle.get_window_extent()  # type: ignore[attr-defined]
    assert extent.x0 >= 0.0 and extent.x1 <= figure.bbox.x1
    drawn = {
        (axis.get_ylabel().split()[0], line.get_label()): line.get_ydata()[0]
        for axis in figures[0].axes
        for line in axis.lines
        if str(line.get_label()).endswith("threshold")
    }
    assert drawn == {
        ("largest", "warning threshold"): pytest.approx(120.0),
        ("largest", "error threshold"): pytest.approx(150.0),
        ("clearance", "warning threshold"): pytest.approx(31.0),
    }
