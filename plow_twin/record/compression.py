"""Decompress the chunks of MCAP files, which use zstd or LZ4."""

from __future__ import annotations

import threading
from typing import Any, Final

from plow_twin.errors import RecordingError

#: Largest size of a record or a chunk [B]. A larger size is treated as damage, because writers close a chunk at a few
#: MiB.
RECORD_LIMIT: Final = 64 * 1024 * 1024
_of_thread: Final = threading.local()


def decompress(compression: str, data: memoryview, size: int) -> bytes:
    """Return the decompressed content of a chunk; decompression stops at `size` bytes."""
    if compression == "zstd":
        import zstandard

        if zstandard.frame_content_size(data) not in (-1, size):
            raise RecordingError(f"chunk: got {zstandard.frame_content_size(data)} bytes, expected {size}")
        content: bytes = _zstd().decompress(data, max_output_size=size)
    elif compression == "lz4":
        import lz4.frame

        content = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    elif not compression:
        content = bytes(data)
    else:
        raise RecordingError(f"compression: got {compression!r}, expected zstd, lz4 or none")
    return content


def _zstd() -> Any:
    """Return the decompressor of this thread. A new decompressor would cost as much time as a small chunk."""
    import zstandard

    if not hasattr(_of_thread, "zstd"):
        _of_thread.zstd = zstandard.ZstdDecompressor()
    return _of_thread.zstd
