"""The messages of several files are merged by the stamps of their roles, without a change of the order in a file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from plow_twin.live.bridge.files import Files
from plow_twin.record.mapping import read_map, stamps_by
from plow_twin.record.merging import merged
from plow_twin.record.sources import Arrived


def rows(topic: str, *seconds: float | None) -> Iterator[Arrived]:
    return (Arrived(topic, -1, second) for second in seconds)


def order(*streams: Iterator[Arrived]) -> list[tuple[str, float | None]]:
    return [
        (row.topic, row.content)
        for row in merged(streams, lambda row: None if row.content is None else round(row.content * 1e9))
    ]


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ((1, 3, 5), (2, 4), "ababa"),
        ((1, None, 5), (2, 4), "aabba"),  # a message without a stamp remains at its place
        ((1, 3, 2.9, 5), (2, 4), "abaaba"),  # a late message
        ((10, 12, 1, 13, 15), (11, 14), "abaaaba"),  # a wrong stamp in the past
        ((10, 12, 99, 13, 15), (11, 14), "abaaaba"),  # a wrong stamp in the future
        ((10, 12, 2, 4), (11, 3), "abaaba"),  # the clock steps back in both files
        ((-4, -3, 5), (-3.5, 0), "ababa"),
    ],
)
def test_streams_are_merged_by_their_stamps(
    one: tuple[float | None, ...], other: tuple[float | None, ...], expected: str
) -> None:
    merged = order(rows("a", *one), rows("b", *other))
    assert "".join(topic for topic, _ in merged) == expected
    assert [value for topic, value in merged if topic == "a"] == list(one)


def test_files_fed_live_are_merged_by_the_stamps_that_the_mapping_reads(tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n" + "".join(f"{t},0,0,0\n" for t in range(8)))
    (tmp_path / "travel.csv").write_text("n,zeit,speed\n" + "7,500,1\n7,3500,-1\n")
    mapping = tmp_path / "map.yaml"
    mapping.write_text("excitation: {topic: load}\ntravel: {topic: travel, stamp: zeit, stamp_unit: ms}\n")
    files = Files([tmp_path / "load.csv", tmp_path / "travel.csv"], follow=False)
    roles = read_map(mapping, files.topics())
    files.start([role.topic for role in roles.values()], stamps_by(roles))
    assert [row.topic for row in files.poll(0.0)] == ["load", "travel", *["load"] * 3, "travel", *["load"] * 4]
    files.close()
