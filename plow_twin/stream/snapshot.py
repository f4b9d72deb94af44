"""The snapshot of a session as bytes."""

from __future__ import annotations

import json
import struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.stream import journal
from plow_twin.stream.model_changes import read_changes
from plow_twin.stream.outputs import STATE_BYTES

#: `SessionState` up to `travel_speed_m_s`, preceded by whether a stamp has been reached, and the number of `travels`.
_HEADER: Final = struct.Struct("<?qqq?dq")
_TRAVEL: Final = struct.Struct("<qd")
_WEAR_BYTES: Final = 8 * PAIR_COUNT


class SessionState(NamedTuple):
    """State from which a session can continue.

    Attributes
    ----------
    origin_ns : int or None
        Stamp of model time 0 [ns]; None if no stamp has been reached.
    stamp_ns : int or None
        Stamp that the model has reached [ns]; None before the first stamp.
    advances : int
        Number of advances.
    held : bool
        Whether the load is held.
    travel_speed_m_s : float
        Travel speed [m/s].
    travels : list of Travel
        Travel speeds that wait for their stamps.
    wear_depth : ndarray, shape (8,)
        Wear depth of each pad [m].
    outputs : bytes
        State of the outputs.
    twin : bytes
        Snapshot of the twin, followed by the changed numbers of the scene as JSON text, if there are any.
    """

    origin_ns: int | None
    stamp_ns: int | None
    advances: int
    held: bool
    travel_speed_m_s: float
    travels: list[journal.Travel]
    wear_depth: NDArray[np.float64]
    outputs: bytes
    twin: bytes

    def pack(self) -> bytes:
        """Return the snapshot."""
        header = _HEADER.pack(
            self.stamp_ns is not None, self.origin_ns or 0, self.stamp_ns or 0, self.advances, self.held,
            self.travel_speed_m_s, len(self.travels),
        )  # fmt: skip
        travels = b"".join(_TRAVEL.pack(travel.stamp_ns, travel.speed_m_s) for travel in self.travels)
        return header + travels + self.wear_depth.tobytes() + self.outputs + self.twin

    @staticmethod
    def unpack(snapshot: bytes) -> SessionState:
        """Return the state in a snapshot."""
        has_origin, origin_ns, stamp_ns, advances, held, speed, count = _HEADER.unpack_from(snapshot)
        wear = _HEADER.size + count * _TRAVEL.size
        outputs = wear + _WEAR_BYTES
        twin = outputs + STATE_BYTES
        return SessionState(
            origin_ns if has_origin else None,
            stamp_ns if has_origin else None,
            advances,
            held,
            speed,
            [journal.Travel(*travel) for travel in _TRAVEL.iter_unpack(snapshot[_HEADER.size : wear])],
            np.frombuffer(snapshot, np.float64, PAIR_COUNT, wear).copy(),
            snapshot[outputs:twin],
            snapshot[twin:],
        )


def with_changes(twin: bytes, changes: dict[str, float]) -> bytes:
    """Return the snapshot of a twin followed by the changed numbers of its scene."""
    # the changes come last, because the size of a twin's snapshot is known where it is read
    return twin + (json.dumps(changes).encode() if changes else b"")


def split_changes(data: bytes, size: int) -> tuple[bytes, dict[str, float]]:
    """Return the twin's snapshot, of `size` bytes, and the changed numbers, from the result of `with_changes`."""
    return data[:size], read_changes(data[size:].decode()) if len(data) > size else {}
