"""The first bytes of a recording, built by hand. A file that begins with them is recognised as a recording."""

from __future__ import annotations

import struct


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def beginning() -> bytes:
    pairs = _text("layout_version") + _text("4")
    metadata = _text("plow_twin") + struct.pack("<I", len(pairs)) + pairs
    return b"\x89MCAP0\r\n" + _record(0x01, _text("ros2") + _text("plow_twin")) + _record(0x0C, metadata)
