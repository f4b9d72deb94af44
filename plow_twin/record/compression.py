"""Decompression of MCAP chunks: zstd and LZ4."""

from __future__ import annotations

import ctypes
import struct
import threading
from collections.abc import Callable
from functools import cache
from typing import Any, Final, cast

import numpy as np

from plow_twin.errors import RecordingError
from plow_twin.record.template import Bytes

#: Largest record and largest content of a chunk [B]; beyond it a length is damage. Writers close a chunk at some MiB.
RECORD_LIMIT: Final = 64 * 1024 * 1024
_of_thread: Final = threading.local()
#: An LZ4 frame: its head, the flags in it, and the length before each block.
_LZ4_HEAD: Final = struct.Struct("<IBB")
_LZ4_MAGIC: Final = 0x184D2204
_LZ4_INDEPENDENT, _LZ4_SIZE = 0x60, 0x08
_LZ4_LENGTH: Final = struct.Struct("<I")


def decompress(compression: str, data: memoryview, size: int) -> bytes | Bytes:
    """Return the content of a chunk, of at most `size` bytes."""
    if compression == "zstd":
        import zstandard

        if zstandard.frame_content_size(data) not in (-1, size):
            raise RecordingError(f"chunk: got {zstandard.frame_content_size(data)} bytes, expected {size}")
        content: bytes = _zstd().decompress(data, max_output_size=size)
    elif compression == "lz4":
        direct = independent_blocks(data, size)
        if direct is not None:
            return direct
        import lz4.frame

        content = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    elif not compression:
        content = bytes(data)
    else:
        raise RecordingError(f"compression: got {compression!r}, expected zstd, lz4 or none")
    return content


@cache
def _lz4_block() -> Callable[[int, int, int, int], int] | None:
    """Return liblz4's LZ4_decompress_safe (source, target, length, room), None where it cannot be called."""
    import lz4.block

    try:
        found: Any = ctypes.CDLL(lz4.block._block.__file__).LZ4_decompress_safe
    except (OSError, AttributeError):
        return None
    found.argtypes, found.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_int), ctypes.c_int
    return cast("Callable[[int, int, int, int], int]", found)


def independent_blocks(data: memoryview, size: int) -> Bytes | None:
    """Return the `size` bytes of an LZ4 frame as the recorder writes it; None for another frame.

    Its blocks are independent and without checksums: the chunk has one. The library decompresses into its own memory
    and copies that, which takes a third longer; with it a replay takes 13 % more processor time.
    """
    block = _lz4_block()
    if block is None or len(data) < _LZ4_HEAD.size or len(data) > RECORD_LIMIT:
        return None
    magic, flags, _ = _LZ4_HEAD.unpack_from(data)
    if magic != _LZ4_MAGIC or flags & ~_LZ4_SIZE != _LZ4_INDEPENDENT:
        return None
    place, done = _LZ4_HEAD.size + 1 + (8 if flags & _LZ4_SIZE else 0), 0
    content = np.empty(size, np.uint8)
    source, target = np.frombuffer(data, np.uint8).ctypes.data, content.ctypes.data
    while place + 4 <= len(data):
        (length,) = _LZ4_LENGTH.unpack_from(data, place)
        place += 4
        if length == 0:
            return content if done == size else None
        if length > len(data) - place:  # cut off, or an uncompressed block, whose highest bit is set
            return None
        count = block(source + place, target + done, length, size - done)
        if count < 0:
            return None
        place, done = place + length, done + count
    return None


def _zstd() -> Any:
    """Return the decompressor of this thread: making its tables takes as long as decompressing a small chunk."""
    import zstandard

    if not hasattr(_of_thread, "zstd"):
        _of_thread.zstd = zstandard.ZstdDecompressor()
    return _of_thread.zstd
