# ruff: noqa: D102
"""Interfaces of the twins that a session can advance."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.model.scene import Scene
from plow_twin.run.advance import Advance
from plow_twin.run.twin import Advanced

Array = NDArray[np.float64]

#: Largest number of measured poses that are stored for a repeated computation of the motion. It is reached after ten
#: seconds at 1 kHz.
MOST_MEASURED: Final = 10_000
#: Time in s from an estimate, or a change of the model, until the twins drawn from it are used. It spreads the work of
#: the draw over 20 samples at 1 kHz.
PREPARATION_S: Final = 0.02
#: Number of steps after which an advance of a live twin fails. They take two to three seconds, in which the node
#: answers no request. A motion with impacts needs up to 2,000 steps a second, with contacts of 1e7 to 1e18 N/m.
MOST_STEPS: Final = 2_000_000


class Driven(Protocol):
    """Methods and properties that a session needs of a twin; `plow_twin.run.twin.Twin` documents them."""

    @property
    def scene(self) -> Scene: ...
    @property
    def excitation(self) -> str: ...
    @property
    def max_evaluations(self) -> int | None: ...
    @property
    def time(self) -> float: ...
    @property
    def wrench(self) -> Array: ...
    @property
    def wear_depth(self) -> Array: ...
    @property
    def bounded(self) -> int: ...
    @property
    def signature(self) -> tuple[bool, ...]: ...

    def like(self, scene: Scene) -> Self: ...
    def failure(self, status: int) -> str: ...
    def warm_up(self) -> float: ...
    def advance(self, t: float, wrench: ArrayLike | None = None) -> Advance: ...
    def advance_rows(
        self, t: Array, wrench: Array, rows: NDArray[np.void] | None, digest_after: NDArray[np.int64] = ...
    ) -> Advanced: ...
    def reset(self, t: float, *, wear_depth: ArrayLike | None = None, pose: Any = None) -> None: ...
    def set_travel_speed(self, speed_m_s: float) -> None: ...
    def snapshot(self) -> bytes: ...
    def restore(self, data: bytes) -> None: ...
    def digest(self) -> str: ...


class PoseCounts(NamedTuple):
    """Numbers of measured poses since the start of the run."""

    #: poses that have moved the members
    used: int = 0
    #: poses that were ignored, because they are too far from their predictions
    outlying: int = 0
    #: poses dropped from a full queue
    dropped: int = 0


class Learned(NamedTuple):
    """Part of the state of a following twin that does not belong to its motion."""

    #: the followed estimate (JSON), whose load waits for a new model time; empty for the prior
    estimate: str
    #: whether poses move the twins
    steered: bool
    poses: PoseCounts


@runtime_checkable
class Following(Driven, Protocol):
    """A twin that is corrected by measured poses and by estimates.

    The rows of its advances contain the additional fields `FOLLOWED_FIELDS` of `plow_twin.stream.outputs`.
    """

    #: number of poses and estimates added so far
    added: int
    #: part of the snapshot, so that a pose counts once if the motion is computed again
    poses: PoseCounts
    #: whether a row that is published alone is returned before its intervals are computed; `catch_up` computes them
    defers: bool

    @property
    def members(self) -> int:
        """Number of twins that are advanced together."""

    def second(self, data: bytes) -> Self:
        """Return a twin with equal settings, which `restore` must set to the snapshot `data` before any other use.

        Calls of `draw_piece` before `restore` spread the work of the latter.
        """

    def draw_piece(self) -> bool:
        """Do the next of five parts of the work of `restore`, and return whether there was a part left."""

    def catch_up(self) -> None:
        """Finish the deferred computation for the newest row. Every other method does so first."""

    def add_pose(self, t: float, q: ArrayLike, known: float = ...) -> None:
        """Add a pose `q`, shape (3,), measured at model time `t` in s; a component that was not measured is NaN.

        The pose has no effect before the model time `known` in s.
        """

    def add_estimate(self, text: str, t: float, start: float = ...) -> None:
        """Add an estimate (JSON) with effect from model time `t` [s]; its window begins at `start` [s].

        In the last `PREPARATION_S` before `t`, its twins are drawn in pieces.
        """

    def learned(self, origin_ns: int | None) -> Learned:
        """Return the part of the state that `learn` sets. `origin_ns` is the stamp of model time 0, if there is any."""

    def learn(self, learned: Learned) -> None:
        """Continue from the present motion with the estimate, the counts and the steering of an earlier state."""

    def begin_at(self, origin_ns: int) -> None:
        """Set the stamp [ns] of model time 0."""

    def follow_parameters(self) -> None:
        """Continue as a single twin from the state of the median twin, without corrections by poses."""

    def end_spans(self, ends: NDArray[np.int64], begins: bool) -> None:
        """Set the indices `ends` of the rows that are published by the next `advance_rows`.

        A span of peaks and impulses ends at each published row. `begins` states whether a new span begins with the
        first row.
        """

    def snapshot_size(self, data: bytes) -> int:
        """Return the length in bytes of the snapshot at the beginning of `data`."""
