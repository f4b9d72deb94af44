"""The page of a run is a single file, which a real browser opens without a network."""

from __future__ import annotations

import re
from pathlib import Path

import browser
import numpy as np
import pytest
from record_support import BASE_NS, STEP_NS, paper_sample, record_run

from plow_twin import read_recording
from plow_twin.cli.app import run as run_cli
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.stream.journal import Entry, Estimated, Mark

ESTIMATE = (
    '{"horizontal": {"mean_m": 0.0261, "p05_m": 0.0259, "p95_m": 0.0263, "state": "estimated"},'
    ' "vertical": {"mean_m": 0.0314, "p05_m": 0.03, "p95_m": 0.033, "state": "not_observable"},'
    ' "model": "ok", "sensor": "ok", "reasons": ["rests <too> long"]}'
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a run with an estimate and a mark, and its page."""
    folder = tmp_path_factory.mktemp("page")
    end = BASE_NS + 400 * STEP_NS
    entries: list[Entry] = [paper_sample(index) for index in range(400)]
    entries += [Estimated(BASE_NS, end, 400, 40, (), (0.0,) * 6, ESTIMATE), Mark(end, "knocks </script> there")]
    entries.append(Mark(end, "alarm: force"))
    entries += [paper_sample(index) for index in range(400, 900)]
    run = record_run(folder / "monday", entries, parameters={"alarm_force": [1e5, 1.5e5]})
    assert run_cli(["view", str(run.folder), "--html", str(folder / "monday.html"), "--quiet"]) == 0
    return run.folder, folder / "monday.html"


def test_the_tables_of_the_page_agree_with_the_run(made: tuple[Path, Path]) -> None:
    run, page = made
    text = page.read_text(encoding="utf-8")
    rows = dict(re.findall(r"<tr><td>(\w+)</td>((?:<td>[^<]*</td>)+)</tr>", text))
    peaks = np.concatenate([part.values for part in read_recording(run)["contact_peaks"].batches()])
    for pair, name in enumerate(PAIR_NAMES):
        cells = re.findall(r"<td>([^<]*)</td>", rows[name])
        assert cells[0] == f"{peaks[:, 16 + pair].max() / 1e3:.1f}"
        assert cells[1] == f"{peaks[-1, pair] - peaks[0, pair]:.0f}"
    assert "26.10 (25.90 to 26.30), estimated" in text and "not observable" in text
    assert "rests &lt;too&gt; long" in text and "knocks &lt;/script&gt; there" in text
    assert "<td>alarm: force</td>" in text and "<td>mark: knocks" in text
    assert "No loss was counted." in text and page.stat().st_size < 10e6


@pytest.mark.skipif(browser.CHROMIUM is None, reason="no Chromium is installed")
def test_a_browser_draws_the_page_without_requests_or_errors(made: tuple[Path, Path], tmp_path: Path) -> None:
    with browser.page(tmp_path, made[1].as_uri()) as page:
        assert page.evaluate("document.querySelectorAll('#plots canvas').length") == 3
        assert page.evaluate("document.images[0].naturalWidth") > 1000
        shown = page.evaluate("drawn[0].scales.x.max - drawn[0].scales.x.min")
        page.evaluate("drawn[0].setScale('x', {min: 0.2, max: 0.4})")
        assert page.evaluate("drawn[0].scales.x.max - drawn[0].scales.x.min") == pytest.approx(0.2) and shown > 0.8
        assert {request.partition(":")[0] for request in page.requests} <= {"file", "data"}
        assert not page.errors


def test_a_page_and_another_picture_exclude_each_other(
    made: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    for others in (["--png", "x.png"], ["--web"], ["--with", "paper"]):
        assert run_cli(["view", str(made[0]), "--html", "x.html", *others]) == 2
        assert "--html" in capsys.readouterr().err
