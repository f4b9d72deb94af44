"""Each number of the estimator is in the table of tuned numbers, or a comment states its origin."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from scenes import ROOT

from plow_twin.estimate import tuning

FOLDER = ROOT / "plow_twin" / "estimate"
#: Words with which a comment states the origin of a number that is not in the tuning table.
ORIGIN = re.compile(r"\b(definition|derived|bounds?|guards?|steps?|prior)\b", re.IGNORECASE)


def unexplained(source: str) -> list[str]:
    """Return the numeric constants of a module without a comment that states their origin.

    A comment applies to all following assignments, up to another comment or an empty line.
    """
    lines, found, explained_until = source.split("\n"), [], -1
    for node in ast.parse(source).body:
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
            continue
        numbers = [
            part.value
            for part in ast.walk(node.value)
            if isinstance(part, ast.Constant) and type(part.value) in (int, float)
        ]
        first = node.lineno - 1
        while first and lines[first - 1].startswith("#:"):
            first -= 1
        comment = " ".join(line.removeprefix("#:").strip() for line in lines[first : node.lineno - 1])
        if ORIGIN.search(comment) or (not comment and explained_until == node.lineno - 1):
            explained_until = node.end_lineno or node.lineno
        elif numbers:
            found.append(lines[node.lineno - 1])
    return found


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.name)
def test_a_number_is_in_the_table_or_states_its_origin(path: Path) -> None:
    if path.name != "tuning.py":
        assert unexplained(path.read_text(encoding="utf-8")) == []


def test_a_new_number_without_an_origin_is_found() -> None:
    assert unexplained("#: Share of draws.\n_NEAR = 0.7\n") == ["_NEAR = 0.7"]
    assert unexplained("_A, _B = 0.7, np.array([1.0])\n") == ["_A, _B = 0.7, np.array([1.0])"]
    assert unexplained("#: Upper bound of the iterations.\n_ROUNDS = 7\n_MORE = 8\n\n_LATER = 9\n") == ["_LATER = 9"]


def test_every_chosen_number_is_used_and_states_its_data() -> None:
    entries = tuning.entries()
    used = " ".join(path.read_text(encoding="utf-8") for path in (ROOT / "plow_twin").rglob("*.py"))
    assert [entry.name for entry in entries if f"tuning.{entry.name}" not in used] == []
    names = {name for name, value in vars(tuning).items() if isinstance(value, (int, float, tuple, np.ndarray))}
    assert names == {entry.name for entry in entries}
    for entry in entries:
        assert entry.unit and entry.meaning and entry.basis, entry.name
