"""Pinned motions: no bit and no count of steps, evaluations or events changes unless somebody means it to.

`pytest test/test_golden.py --golden-update` pins anew for the present build. A build without a file of its own is
held to the counts of another one: rounding moves single events, not the work.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from golden import CASES, build_name

FOLDER = Path(__file__).resolve().parent / "data" / "golden"
#: By how much rounding may change a count on another build.
OTHER_BUILD = 0.02


@cache
def pinned(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


@pytest.mark.parametrize("case", CASES)
def test_no_bit_has_changed(case: str, request: pytest.FixtureRequest) -> None:
    own, found = FOLDER / f"{build_name()}.json", CASES[case]()
    if request.config.getoption("--golden-update"):
        kept = json.loads(own.read_text(encoding="utf-8")) if own.exists() else {}
        kept = {name: figures for name, figures in (kept | {case: found}).items() if name in CASES}
        own.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    elif own.exists():
        assert found == pinned(own)[case]
    else:
        other = pinned(sorted(FOLDER.glob("*.json"))[0])[case]
        for name in set(other) - {"digest"}:
            assert found[name] == pytest.approx(other[name], rel=OTHER_BUILD, abs=3), name


def test_every_pinned_motion_is_still_a_case() -> None:
    for path in FOLDER.glob("*.json"):
        assert set(pinned(path)) == set(CASES)
