"""The study of the paper: its files, numbers equal to those of the run, and its list of disagreements."""

from __future__ import annotations

import base64
import csv
import itertools
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from record_support import records_of
from scenes import ROOT, preset

from plow_twin import Result, Scene, SolverError, simulate
from plow_twin.cli.app import run
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.replay import replay
from plow_twin.scene_file import dump_scene
from plow_twin_paper import runs as paper_runs
from plow_twin_paper import sets as paper_sets
from plow_twin_paper.contradictions import contradictions
from plow_twin_paper.rows import FITTED, Row, Verdict
from plow_twin_paper.rows_trends import rises, rises_then_falls, rows
from plow_twin_paper.runs import Sweep
from plow_twin_paper.sets import Hold
from plow_twin_paper.study import PaperStudy, compare
from plow_twin_paper.values import FORCES

FIGURES = [f"paper_fig{number:02}" for number in (6, 7, 8, 9, 10, 11, 13, 14, 15)] + ["paper_rotation"]


@pytest.fixture(scope="module")
def study() -> PaperStudy:
    return compare(preset("paper"), 60.0)


def row(study: PaperStudy, what: str) -> Row:
    (found,) = [row for row in study.rows if row.what == what]
    return found


def test_the_command_writes_a_report_a_table_and_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "report"
    command = [
        sys.executable,
        "-m",
        "plow_twin",
        "study",
        "paper",
        "--t-end",
        "6.5",
        "--workers",
        "2",
        "--out",
        str(out),
    ]
    completed = subprocess.run(
        command, capture_output=True, text=True, timeout=110, stdin=subprocess.DEVNULL, check=False
    )
    assert (completed.returncode, completed.stderr) == (0, "")

    html = (out / "report.html").read_text()
    images = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    files = [(out / "figures" / f"{name}.png").read_bytes() for name in FIGURES]
    assert [base64.b64decode(image) for image in images] == files
    assert all(re.search(rb"Title\0[^\0]+; scene paper, 20\d\d-\d\d-\d\d", file) for file in files)
    assert not re.search(r'(src|href)="(?!data:)', html)  # the page needs no other file and no network

    document = json.loads((out / "table.json").read_text())
    with (out / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [entry["what"] for entry in table] == [entry["what"] for entry in document["rows"]]
    assert {entry["verdict"] for entry in table} == {"yes", "no"}
    for entry in document["rows"]:
        assert entry["criterion"] and entry["inputs"] and entry["source"] and entry["published_mark"] == "given"
        assert entry["what"].replace("'", "&#39;") in html
    assert sum(document["verdicts"].values()) == len(table)
    assert f"agrees? yes: {document['verdicts']['yes']}, no: {document['verdicts']['no']}" in completed.stdout

    assert (out / "run.rrd").read_bytes()[:4] == b"RRF2"
    reader = RunReader(out / "run")
    assert sum(1 for _ in records_of(reader)) > 6500
    assert reader.status is FileStatus.COMPLETE
    assert document["recording_error_m"] < 1e-6
    assert replay(out / "run").divergences == 0

    assert run(["study", "paper", "--out", str(out)]) == 2  # existing files are not overwritten
    assert "expected a new folder" in " ".join(capsys.readouterr().err.split())


def test_forces_agree_with_the_reconstruction(study: PaperStudy) -> None:
    expected = {
        "counter-clockwise: largest force, at a": (153.0, 147.60, -0.035, Verdict.AGREES),
        "counter-clockwise: largest mean force, at a": (74.0, 74.99, 0.013, Verdict.AGREES),
        "clockwise: largest force, at b": (177.0, 183.25, 0.035, Verdict.AGREES),
        "clockwise: largest mean force, at b": (82.0, 90.24, 0.101, Verdict.DISAGREES),
    }
    for what, (published, value, difference, verdict) in expected.items():
        statement = row(study, what)
        assert statement.published_value == published
        assert statement.value == pytest.approx(value, abs=0.005)
        assert statement.difference == pytest.approx(difference, abs=5e-4)
        assert statement.verdict is verdict


def test_trends_agree_with_the_reconstruction(study: PaperStudy) -> None:
    vertical, horizontal = (np.round(sweep.on_grid() / 1e3) for sweep in (study.runs.vertical, study.runs.horizontal))
    np.testing.assert_array_equal(vertical[:, 0], [136, 138, 136, 130, 126])
    np.testing.assert_array_equal(vertical[:, 1], [172, 175, 174, 171, 169])
    np.testing.assert_array_equal(horizontal[:, 0], [136, 143, 146, 150, 153])
    np.testing.assert_array_equal(horizontal[:, 1], [172, 180, 184, 184, 191])
    for corner, along, verdict in (("a", "vertical", "yes"), ("c", "vertical", "no"), ("b", "horizontal", "yes")):
        assert row(study, f"point {corner}: largest force against {along} clearance").verdict.value == verdict


def test_disagreements_are_listed(study: PaperStudy) -> None:
    for sense, share in (("counter-clockwise", 67.0), ("clockwise", 76.0)):
        four = row(study, f"{sense}: one, two and three points; four are not mentioned")
        assert four.verdict is Verdict.DISAGREES
        assert four.value == pytest.approx(share, abs=0.5)
    assert row(study, "a is loaded more than c and d, largest force").verdict is Verdict.DISAGREES
    assert row(study, "b is loaded more than c and d, largest force").verdict is Verdict.AGREES
    assert "at c" in row(study, "counter-clockwise: largest force is at a").computed
    # the set `a` lasts only 0.8 ms, which is too short to count
    assert row(study, "clockwise: {a} occurs").verdict is Verdict.DISAGREES
    quoted = [entry for entry in study.rows if "contact at 5" in entry.what]
    assert [entry.verdict for entry in quoted] == [Verdict.DISAGREES] * 6
    statements = " ".join(entry.statement for entry in contradictions(study.runs))
    for word in ("53.8 s", "twice the penetration", "upper points", "English captions state the reverse", "57.85 s"):
        assert word in statements


def test_a_second_reconstruction_gets_its_own_verdicts(study: PaperStudy) -> None:
    # with other signs of loads and arms and another contact, the scene reproduces the forces at a and b, but misses
    # another trend
    scene = preset("paper")
    fx1, fx2, fx3, fy = scene.loads
    loads = (
        replace(fx1, force_n=(-92e3, 0.0), at_m=(0.0, -0.72)),
        replace(fx2, force_n=(36e3, 0.0), at_m=(0.0, -0.415)),
        replace(fx3, force_n=(96e3, 0.0), at_m=(0.0, -0.01)),
        fy,
    )
    contact = replace(scene.contact, stiffness=1.3054e7, damping=0.92118)
    second = compare(replace(scene, loads=loads, contact=contact), 60.0)
    for what, value in (
        ("counter-clockwise: largest force, at a", 162.0),
        ("counter-clockwise: largest mean force, at a", 68.0),
        ("clockwise: largest force, at b", 171.0),
        ("clockwise: largest mean force, at b", 85.0),
    ):
        assert row(second, what).value == pytest.approx(value, abs=0.5)
    np.testing.assert_array_equal(np.round(second.runs.vertical.on_grid()[:4, 1] / 1e3), [157, 155, 152, 146])
    falls = "point b: largest force against vertical clearance"  # the curve decreases from its first point
    assert [row(each, falls).verdict for each in (study, second)] == [Verdict.AGREES, Verdict.DISAGREES]


def test_another_stiffness_gives_other_verdicts(study: PaperStudy) -> None:
    scene = preset("paper")
    other = compare(replace(scene, contact=replace(scene.contact, stiffness=4.0 * scene.contact.stiffness)), 20.0)
    before, after = ({entry.what: entry for entry in each.rows} for each in (study, other))
    assert before.keys() == after.keys()
    assert {what: entry.published for what, entry in before.items()} == {w: e.published for w, e in after.items()}
    changed = [what for what, entry in before.items() if entry.verdict is not after[what].verdict]
    assert "clockwise: largest force, at b" in changed
    assert len(changed) >= 5
    assert after["clockwise: largest force, at b"].difference > 0.2


def test_contact_sets_from_the_events_agree_with_the_solver(study: PaperStudy) -> None:
    for sense in ("ccw", "cw"):
        timeline = paper_sets.holds(study.runs.scene, study.runs.case, sense)
        assert (timeline[0].start_s, timeline[-1].end_s) == (0.0, 60.0)
        assert all(first.end_s == second.start_s for first, second in itertools.pairwise(timeline))
        shares = {name: figures.share for name, figures in paper_sets.figures(timeline).items()}
        assert shares == pytest.approx(dict(study.runs.case.contact_sets[sense]), abs=1e-9)
    forces = study.runs.case.force  # the sets from the events agree with the forces of the rows
    letters, chosen = paper_sets.letters_of_pairs(study.runs.scene), paper_sets.of_sense("cw")
    for index in range(0, len(forces), 997):
        from_solver = {letters[pair] for pair in range(8) if chosen[pair] and forces[index, pair] > 0.0}
        assert set(paper_sets.at(timeline, float(study.runs.case.t[index]))) == from_solver


def test_published_forces_agree_with_the_calibration_s_targets() -> None:
    targets = yaml.safe_load((ROOT / "config" / "paper_targets.yaml").read_text())["targets"]
    ours = {f"{force.statistic}.{force.sense}.{force.corner}": force.value_n for force in FORCES}
    assert ours == {target["statistic"]: target["value"] for target in targets if "value" in target}


def test_a_contact_set_counts_if_it_lasts_five_milliseconds() -> None:
    timeline = [Hold(0.0, 1.0, ""), Hold(1.0, 1.004, "a"), Hold(1.004, 1.010, "ab"), Hold(1.010, 1.014, "a")]
    figures = paper_sets.figures(timeline)
    # two contacts of 4 ms each are not a contact of 5 ms
    assert (figures["a"].count, figures["ab"].count) == (0, 1)
    assert figures["a"].share == pytest.approx(8 / 14)
    distance, hold = paper_sets.nearest(timeline, 1.009, "a") or (None, None)
    assert distance == pytest.approx(0.001)
    assert hold == timeline[3]


@pytest.mark.parametrize(
    ("values", "up", "up_and_down"),
    [
        ([1.0, 2.0, 3.0], True, False),
        ([1.0, 3.0, 2.0], False, True),
        ([100.0, 110.0, 109.8, 120.0], True, False),  # this decrease would not be visible in a printed curve
        ([100.0, 110.0, 105.0, 120.0], False, False),
        ([100.0, 100.2, 100.0], False, False),
        ([3.0, 2.0, 1.0], False, False),
    ],
)
def test_trends_rise_and_fall_by_the_stated_rule(values: list[float], up: bool, up_and_down: bool) -> None:
    assert (rises(np.array(values)), rises_then_falls(np.array(values))) == (up, up_and_down)


def test_a_failed_run_gives_no_verdict(study: PaperStudy) -> None:
    forces = study.runs.vertical.largest_n.copy()
    forces[10] = np.nan
    table = rows(replace(study.runs, vertical=Sweep(study.runs.vertical.clearance_m, forces)))
    verdicts = [entry.verdict for entry in table if entry.group.startswith("Vertical")]
    assert verdicts == [Verdict.NOT_COMPUTED] * 5
    assert all(entry.verdict is not Verdict.NOT_COMPUTED for entry in table if not entry.group.startswith("Vertical"))


def test_a_failed_run_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(scene: Scene, t_end: float, output_dt: float) -> Result:
        if (scene.clearance.horizontal_m, scene.clearance.vertical_m) == (0.020, 0.030):
            raise SolverError("at t = 1 s: for this test")
        return simulate(scene, t_end, output_dt)

    monkeypatch.setattr(paper_runs, "simulate", failing)
    study = compare(preset("paper"), 6.5)
    assert study.runs.failed == 1
    lost = [entry for entry in study.rows if entry.verdict is Verdict.NOT_COMPUTED]
    assert [entry.source for entry in lost] == ["section 5, Fig. 14"] * 4


def test_the_page_has_the_run_s_numbers(study: PaperStudy) -> None:
    text = (ROOT / "docs" / "study.md").read_text()
    yes = study.verdicts["yes"]
    fitted = [entry for entry in study.rows if entry.inputs == FITTED]
    agree = sum(entry.verdict is Verdict.AGREES for entry in fitted)
    sentence = (
        f"Of {len(study.rows)} statements, {yes} agree. R1 was fitted to {len(fitted)} of the {len(study.rows)} "
        f"statements. Of these {len(fitted)}, {agree} agree."
    )
    assert sentence in " ".join(text.split())
    for entry in study.rows:
        if entry.difference is not None:
            assert f"| {entry.published} kN | {entry.computed} kN, {100 * entry.difference:+.1f} % |" in text
    values = {entry.what: entry for entry in study.rotation}
    for what in ("counter-clockwise, a", "clockwise, b", "clockwise, d"):
        assert f"{values[f'{what}: largest force'].consistent:.1f}" in text


def test_the_exact_rigid_body_falls_without_turning(study: PaperStudy) -> None:
    rotation = study.runs.rotation
    assert rotation is not None
    np.testing.assert_array_equal(rotation.results[0].q, study.runs.case.q)
    head, t = study.runs.scene.head, study.runs.case.t[20]
    turned = [float(result.q[20, 2]) for result in rotation.results]
    # the moment of gravity rotates the first body at once; it has no moment about the centre of mass of the second
    # body, which only the loads rotate, in proportion to t^3
    assert turned[0] == pytest.approx(-0.5 * head.mass_kg * 9.81 * 0.255 / head.inertia_kg_m2 * t**2, rel=0.15)
    assert abs(turned[1]) < 0.15 * abs(turned[0])
    values = {entry.what: entry for entry in study.rotation}
    largest = values["counter-clockwise, a: largest force"]
    assert largest.constant == pytest.approx(147.60, abs=0.005)
    assert abs(largest.change(largest.consistent) or 0.0) > 0.05
    assert {change.form for change in study.changes} == {
        "exact, I about the centre of mass", "exact, I about the cavity's centre",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--t-end", "3"], "got 3 s, expected 6.2832 s (two periods of the load) to 1000 s"),
        (["--t-end", "1e6"], "got 1e+06 s, expected 6.2832 s"),
        (["--scene", "no_letters.yaml"], "frame.labels: got {}, expected the letters a, b, c, d"),
        (["--workers", "0"], "--workers"),
    ],
)
def test_bad_input_is_one_clear_error(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = preset("paper")
    Path("no_letters.yaml").write_text(dump_scene(replace(scene, frame=replace(scene.frame, labels={}))))
    assert run(["study", "paper", "--out", str(tmp_path / "out"), *arguments]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
