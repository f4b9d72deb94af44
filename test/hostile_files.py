"""Malicious and damaged recordings."""

from __future__ import annotations

import io
import sqlite3
import struct
import zipfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import zstandard

from plow_twin.record.cdr import encode, schema_text
from plow_twin.record.header import HEADER_RECORD, RunHeader
from plow_twin.record.messages import Text, WrenchStamped
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.scene_file.presets import scene_path

MAGIC = b"\x89MCAP0\r\n"
NEXT_TYPE = "=" * 80 + "\nMSG: "
_T0 = 1_800_000_000_000_000_000


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _pairs(pairs: dict[str, str]) -> bytes:
    data = b"".join(_text(key) + _text(value) for key, value in pairs.items())
    return struct.pack("<I", len(data)) + data


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def channel(number: int, schema: int, topic: str) -> bytes:
    return record(4, struct.pack("<HH", number, schema) + _text(topic) + _text("cdr") + _pairs({}))


def schema(number: int, name: str, text: str) -> bytes:
    return record(3, struct.pack("<H", number) + _text(name) + _text("ros2msg") + _text(text))


def message(number: int, sequence: int, data: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", number, sequence, _T0 + sequence, _T0 + sequence) + data)


def chunk(content: bytes, size: int | None = None, compression: str = "zstd", data: bytes | None = None) -> bytes:
    """Return an MCAP chunk whose header states an unpacked size of `size` bytes."""
    data = zstandard.compress(content) if data is None else data
    head = struct.pack("<QQQI", 0, 0, len(content) if size is None else size, 0)
    return record(6, head + _text(compression) + struct.pack("<Q", len(data)) + data)


def _end() -> bytes:
    return record(0x0F, struct.pack("<I", 0)) + record(2, struct.pack("<QQI", 0, 0, 0)) + MAGIC


@cache
def _header() -> dict[str, str]:
    return RunHeader(dump_scene(load_scene(scene_path("paper")))).to_record()


def run(*entries: str, more: bytes = b"", **changed: str) -> bytes:
    """Return a run of plow_twin with 20 samples, more journal entries and records, and changed keys of the header."""
    samples = [WrenchStamped(_T0 + n * 1_000_000, "slide_frame", (1e3 * n, 0.0, 0.0), (0.0,) * 3) for n in range(20)]
    body = b"".join(message(1, n, encode(sample)) for n, sample in enumerate(samples))
    body += b"".join(message(2, 20 + n, encode(Text(entry))) for n, entry in enumerate(entries))
    declared = schema(1, WrenchStamped.TYPE, schema_text(WrenchStamped.TYPE)) + schema(2, Text.TYPE, "string data\n")
    declared += channel(1, 1, "/plow_twin/journal/samples") + channel(2, 2, "/plow_twin/journal/entries")
    head = record(1, _text("ros2") + _text("x")) + record(0x0C, _text(HEADER_RECORD) + _pairs(_header() | changed))
    return MAGIC + head + declared + chunk(body) + more + _end()


def foreign(text: str, channels: int = 1) -> bytes:
    """Return a recording of another program: a topic /load whose type `text` defines, and more topics."""
    declared = schema(1, "a/msg/A", text) + b"".join(
        channel(n % 65536, 1, f"/load{n - 1 if n > 1 else ''}") for n in range(1, channels + 1)
    )
    body = b"".join(message(1, n, b"\0\1\0\0" + bytes(100)) for n in range(1000))
    return MAGIC + record(1, _text("ros2") + _text("x")) + declared + chunk(body) + _end()


def bag(path: Path, *statements: str) -> None:
    """Write a rosbag2 sqlite3 file with a topic /load. The SQL statements insert its messages."""
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        base.execute("INSERT INTO topics VALUES(1, '/load', 'geometry_msgs/msg/WrenchStamped')")
        for statement in statements:
            base.execute(statement)
    base.close()


def archive(path: Path, size: Sequence[int], kind: str, data: bytes) -> None:
    """Write an npz file whose headers state a shape and a type for the arrays `t` and `q`."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as found:
        for name in ("t", "q"):
            head = io.BytesIO()
            np.lib.format.write_array_header_1_0(
                head, {"descr": kind, "fortran_order": False, "shape": (*size, *((3,) if name == "q" else ()))}
            )
            found.writestr(f"{name}.npy", head.getvalue() + data)


def _view(path: Path) -> None:
    endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c)"
    bag(path, f"CREATE VIEW messages AS {endless} SELECT x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM c")


def _computed(path: Path) -> None:
    bag(
        path,
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB AS (zeroblob(1000000000)))",
        "INSERT INTO messages VALUES(1, 1, 5)",
    )


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(10**9)


def _nested(levels: int, field: str) -> str:
    types = "".join(f"{NEXT_TYPE}a/T{n}\n{field.format(n + 1)}\n" for n in range(1, levels))
    return f"{field.format(1)}\n{types}{NEXT_TYPE}a/T{levels}\nuint8 x\n"


MADE: dict[str, Callable[[Path], object]] = {
    "deep.mcap": lambda path: path.write_bytes(run('{"kind": ' + "[" * 1_000_000)),
    "number.mcap": lambda path: path.write_bytes(run('{"kind": "loss", "count": 1' + "0" * 400 + "}")),
    "nan.mcap": lambda path: path.write_bytes(run('{"kind": "travel", "stamp_ns": 5, "speed_m_s": NaN}')),
    "header_deep.mcap": lambda path: path.write_bytes(run(topics="[" * 1_000_000)),
    "header_kind.mcap": lambda path: path.write_bytes(run(parameters="7")),
    "header_number.mcap": lambda path: path.write_bytes(run(origin_ns="1" + "0" * 400)),
    "header_file.mcap": lambda path: path.write_bytes(
        run(
            scene_yaml=_header()["scene_yaml"].partition("loads:")[0]
            + "loads: [{name: a, table: {file: /etc/passwd, columns: [t, fx, fy, m]}}]\n"
        )
    ),
    "channels.mcap": lambda path: path.write_bytes(
        run(more=b"".join(channel(n % 65536, 1, f"/t{n}") for n in range(100_000)))
    ),
    # two files of 170 kB unpack to 5 GB: the first has too large chunks, the second has too many chunks
    "large_chunks.mcap": lambda path: path.write_bytes(run(more=20 * chunk(bytes(250 * 2**20)))),
    "many_chunks.mcap": lambda path: path.write_bytes(run(more=100 * chunk(bytes(50 * 2**20)))),
    "lying_zstd.mcap": lambda path: path.write_bytes(
        run(more=100 * chunk(b"", 2**26, data=zstandard.ZstdCompressor(write_content_size=False).compress(b"0")))
    ),
    "lying_lz4.mcap": lambda path: path.write_bytes(
        run(more=100 * chunk(b"", 2**26, "lz4", struct.pack("<IBBBI", 0x184D2204, 0x60, 0x40, 0, 0)))
    ),
    "lying_length.mcap": lambda path: path.write_bytes(run(more=struct.pack("<BQ", 6, 2**63 - 1))),
    "array.mcap": lambda path: path.write_bytes(foreign("float64[1000000000] x\n")),
    "texts.mcap": lambda path: path.write_bytes(foreign("string[1000000000] x\n")),
    "nothing.mcap": lambda path: path.write_bytes(foreign(f"a/E[1000000000] x\n{NEXT_TYPE}a/E\n# no field\n")),
    "itself.mcap": lambda path: path.write_bytes(foreign("a/A x\n")),
    "tree.mcap": lambda path: path.write_bytes(foreign(_nested(9, "a/T{0}[1000] x"))),
    "chain.mcap": lambda path: path.write_bytes(foreign(_nested(3000, "a/T{0} x"))),
    "empty_lines.mcap": lambda path: path.write_bytes(foreign("\n" * 1_000_000)),
    "topics.mcap": lambda path: path.write_bytes(foreign("float64 x\n", 1_000_000)),
    "view.db3": _view,
    "computed.db3": _computed,
    "columns.csv": lambda path: path.write_text("t,fx,fy,m" + ",c" * 1_000_000 + "\n" + "1," * 1_000_000 + "\n"),
    "line.csv": _sparse,
    "row.csv": lambda path: path.write_text("t,fx,fy,m\n" + '"\n",' * 2_000_000),
    "pickle.npz": lambda path: archive(path, (2,), "|O", b"cos\nsystem\n(S'false'\ntR."),
    "shape.npz": lambda path: archive(path, (10**12,), "<f8", b""),
    "unpacked.npz": lambda path: archive(path, (10**7,), "<f8", bytes(3 * 80_000_000)),
    "zip.npz": lambda path: path.write_bytes(b"PK\3\4" + bytes(100)),
}
