# ruff: noqa: D102
"""Interfaces that a session drives: a twin, and a twin that follows measurements."""

from __future__ import annotations

from typing import Any, Final, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.model.scene import Scene
from plow_twin.run.advance import Advance
from plow_twin.run.twin import Advanced

Array = NDArray[np.float64]

#: Largest number of measured poses that are kept in case the motion is computed again: ten seconds at 1 kHz.
MOST_MEASURED: Final = 10_000


class Driven(Protocol):
    """The part of a twin that a session needs; `plow_twin.run.twin.Twin` documents it."""

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


@runtime_checkable
class Following(Driven, Protocol):
    """A twin that follows measurements; its rows have more columns (`followed` in `plow_twin.solve.state.ROW`)."""

    #: number of poses and estimates added so far
    added: int
    #: whether `catch_up` does the work on intervals and measurements of a row that is published alone
    defers: bool

    def catch_up(self) -> None:
        """Finish the work that was left after the newest row; every other call does this first."""

    def add_pose(self, t: float, q: ArrayLike, known: float = ...) -> None:
        """Add a pose `q`, shape (3,), measured at model time `t` in s; components not measured are NaN.

        The pose has an effect from model time `known` in s on.
        """

    def add_estimate(self, text: str, t: float, start: float = ...) -> None:
        """Add an estimate (JSON) that has an effect from model time `t` in s on; its window begins at `start` in s."""

    @property
    def known(self) -> str:
        """The estimate that is followed (JSON); empty: the prior."""

    def follow_estimate(self, known: str) -> None:
        """Continue from the present state with an estimate that `known` returned."""

    def follow_parameters(self) -> None:
        """Continue as a single twin from the state of the median twin, without corrections by poses."""

    def end_spans(self, ends: NDArray[np.int64], begins: bool) -> None:
        """Set which rows of the next `advance_rows` are published, and whether the first begins a span."""

    def snapshot_size(self, data: bytes) -> int:
        """Return the length of the snapshot with which `data` begins."""
