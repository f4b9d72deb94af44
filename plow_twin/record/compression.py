"""Decompress the chunks of MCAP files, which use zstd or LZ4."""

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

#: Largest size of a record or a chunk [B]. A larger size is treated as damage, because writers close a chunk at a few
#: MiB.
RECORD_LIMIT: Final = 64 * 1024 * 1024
_of_thread: Final = threading.local()
#: Format of an LZ4 frame. The head contains the magic number and flags, and a length precedes each block.
_LZ4_HEAD: Final = struct.Struct("<IBB")
_LZ4_MAGIC: Final = 0x184D2204
_LZ4_INDEPENDENT, _LZ4_SIZE = 0x60, 0x08
_LZ4_LENGTH: Final = struct.Struct("<I")


def decompress(compression: str, data: memoryview, size: int) -> bytes | Bytes:
    """Return the decompressed content of a chunk; decompression stops at `size` bytes."""
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
    import lz4.block

    try:
        function: Any = ctypes.CDLL(lz4.block._block.__file__).LZ4_decompress_safe
    except (OSError, AttributeError):
        return None
    function.argtypes, function.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_int), ctypes.c_int
    return cast("Callable[[int, int, int, int], int]", function)


def independent_blocks(data: memoryview, size: int) -> Bytes | None:
    """Return the decompressed content of an LZ4 frame that has independent blocks and no checksums.

    The recorder writes frames of this kind. The blocks are decompressed directly into the result, which saves the copy
    that the package lz4 makes.

    Returns
    -------
    ndarray of uint8, shape (size,), or None
        None if the frame has another format, is damaged, or has another size.
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
        if length > len(data) - place:  # the block is truncated, or it is not compressed (the highest bit is set)
            return None
        count = block(source + place, target + done, length, size - done)
        if count < 0:
            return None
        place, done = place + length, done + count
    return None


def _zstd() -> Any:
    """Return the decompressor of this thread. A new decompressor would cost as much time as a small chunk."""
    import zstandard

    if not hasattr(_of_thread, "zstd"):
        _of_thread.zstd = zstandard.ZstdDecompressor()
    return _of_thread.zstd
