"""Damaged files of each kind: readers reject them with errors of this package only."""

from __future__ import annotations

import csv
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hostile_files import run as recorded
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from plow_twin.errors import PlowTwinError
from plow_twin.record.cdr import decode, encode
from plow_twin.record.column_guess import guess_columns
from plow_twin.record.mapping import messages_of, read_map, readings
from plow_twin.record.messages import JointState, WrenchStamped
from plow_twin.record.reader import RunReader
from plow_twin.record.sources import open_source
from plow_twin.scene_file import load_scene, loads_scene
from plow_twin.scene_file.presets import scene_path

pytestmark = [pytest.mark.stress, pytest.mark.timeout(3600)]
#: Number of examples of each kind. All kinds together take about an hour: 42 examples per second on a busy core.
EXAMPLES = 20_000
FUZZ = settings(
    max_examples=EXAMPLES, deadline=None, suppress_health_check=[*HealthCheck], print_blob=True, database=None
)
#: Changes of a file: the place (as a share of the file), the number of removed bytes, and the inserted bytes.
CHANGES = st.lists(
    st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 64), st.binary(max_size=64)), min_size=1, max_size=8
)


def _changed(data: bytes, changes: list[tuple[float, int, bytes]]) -> bytes:
    for share, gone, new in changes:
        place = int(share * len(data))
        data = data[:place] + new + data[place + gone :]
    return data


@cache
def _scene() -> bytes:
    return scene_path("paper").read_bytes()


@cache
def _run() -> bytes:
    return recorded()


def _columns() -> bytes:
    return b"t,fx,fy,m,x\n" + b"".join(b"%d.5,1,-2e3,%d,\n" % (n, 3 * n) for n in range(30))


def _read_scene(path: Path) -> None:
    loads_scene(path.read_text(errors="replace"))


def _read_mapping(path: Path) -> None:
    read_map(path, None)


def _read_foreign(path: Path) -> None:
    source = open_source(path)
    roles = read_map(None, source.topics())
    for _ in readings(messages_of(source, roles), roles):
        pass


def _read_run(path: Path) -> None:
    reader = RunReader(path)
    reader.header.scene(path)
    for _ in reader.batches(outputs=True):
        pass


def _guess(path: Path) -> None:
    guess_columns(path, load_scene("paper"), {}, {})


KINDS: dict[str, tuple[Callable[[], bytes], str, Callable[[Path], None]]] = {
    "scene": (_scene, "a.yaml", _read_scene),
    "mapping": (
        lambda: b"excitation: {topic: a/b, fields: {fx: 'x[0]', fy: y, m: m}, unit: {fx: kN}, limits: {fx: [1, 2]}}\n",
        "a.yaml",
        _read_mapping,
    ),
    "run": (_run, "a.mcap", _read_run),
    "recording": (_run, "b.mcap", _read_foreign),
    "table": (_columns, "a.csv", _read_foreign),
    "guess": (_columns, "b.csv", _guess),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_is_refused_by_an_error_of_the_package(
    kind: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    whole, name, read = KINDS[kind]
    path = tmp_path_factory.mktemp("fuzz") / name

    @FUZZ
    @given(CHANGES)
    def check(changes: list[tuple[float, int, bytes]]) -> None:
        path.write_bytes(_changed(whole(), changes))
        with suppress(PlowTwinError, csv.Error):
            read(path)

    check()


MESSAGES = (
    WrenchStamped(10**18, "frame", (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
    JointState(10**18, "frame", ("a", "b"), *([np.array([1.0, 2.0])] * 3)),
)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_damaged_ros_message_is_refused(message: WrenchStamped | JointState) -> None:
    whole = encode(message)

    @FUZZ
    @given(CHANGES)
    def check(changes: list[tuple[float, int, bytes]]) -> None:
        with suppress(PlowTwinError):
            decode(_changed(whole, changes), message.TYPE)

    check()
