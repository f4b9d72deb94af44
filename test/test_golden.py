"""Pinned motions: their bits, and their numbers of steps, evaluations and events, change only on purpose.

`pytest test/test_golden.py --golden-update` pins them again for the present build. A build without pinned motions is
compared with the counts of another build, because rounding may change single events but not the total work.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from golden import CASES, build_name

FOLDER = Path(__file__).resolve().parent / "data" / "golden"
PROGRAM = Path(__file__).resolve().parent / "golden.py"
#: Motions that are computed a second time: a single run, a twin, and twins in lanes.
LOADED = ("law kelvin_voigt", "samples", "batch")
#: Largest relative change of a count that rounding may cause on another build.
OTHER_BUILD = 0.02

# compiling all kernels takes long
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    """Compute the figures in two processes, which must agree: one compiles the kernels, and the other loads some."""
    compiled, loaded = (
        subprocess.run([sys.executable, PROGRAM, *names], capture_output=True, text=True, check=False)
        for names in ((), LOADED)
    )
    assert compiled.returncode == loaded.returncode == 0, compiled.stderr + loaded.stderr
    figures: dict[str, Any] = json.loads(compiled.stdout)
    assert json.loads(loaded.stdout) == {name: figures[name] for name in LOADED}
    return figures


@pytest.fixture(scope="module")
def pinned() -> dict[str, Any]:
    """Return the figures of this build. If there are none, return those of another build without their hashes."""
    own = FOLDER / f"{build_name()}.json"
    path = own if own.exists() else sorted(FOLDER.glob("*.json"))[0]
    figures: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if path != own:
        for case in figures.values():
            case.pop("digest", None)
    return figures


def test_no_pinned_motion_is_missing(found: dict[str, Any], request: pytest.FixtureRequest) -> None:
    if request.config.getoption("--golden-update"):
        own = FOLDER / f"{build_name()}.json"
        own.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    for path in FOLDER.glob("*.json"):
        assert set(json.loads(path.read_text(encoding="utf-8"))) == set(CASES)


@pytest.mark.parametrize("case", CASES)
def test_no_bit_and_no_count_has_changed(case: str, found: dict[str, Any], pinned: dict[str, Any]) -> None:
    if "digest" in pinned[case]:
        counts = {name: count for name, count in pinned[case].items() if name != "digest"}
        assert found[case] == {"digest": found[case]["digest"], **counts}
        assert found[case]["digest"] in pinned[case]["digest"].split()
    for name in pinned[case]:
        if name != "digest":
            assert found[case][name] == pytest.approx(pinned[case][name], rel=OTHER_BUILD, abs=3), name
