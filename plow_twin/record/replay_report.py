"""The result of a replay."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from plow_twin.record.reader import FileStatus


@dataclass(frozen=True)
class Divergence:
    """A difference between recording and replay at advance number `step` (from 0), on `topic`, in `field`."""

    step: int
    stamp_ns: int
    topic: str
    field: str
    recorded: str
    computed: str

    def __str__(self) -> str:
        return (
            f"step {self.step}, stamp {self.stamp_ns} ns, {self.topic}: {self.field}: "
            f"recorded {self.recorded}, computed {self.computed}"
        )


@dataclass
class ReplayReport:
    """The result of a replay; `compared` and `not_compared` count messages by base name of their topic.

    `inputs` counts messages by input and outcome, and `repeated` the entries that occur more than once.
    `repeated_parts` maps each file that repeats a part to the file that is read, and `foreign_parts` maps each file of
    another run to the keys of its header that differ.
    """

    path: Path
    entries: int = 0
    samples: int = 0
    steps: int = 0
    refused: int = 0
    repeated: int = 0
    digests_compared: int = 0
    snapshots_compared: int = 0
    compared: Counter[str] = field(default_factory=Counter)
    not_compared: Counter[str] = field(default_factory=Counter)
    divergences: int = 0
    first_divergence: Divergence | None = None
    status: FileStatus = FileStatus.UNREAD
    stop_reason: str | None = None
    damaged_chunks: int = 0
    repeated_parts: dict[str, str] = field(default_factory=dict)
    foreign_parts: dict[str, list[str]] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    inputs: dict[str, dict[str, int]] = field(default_factory=dict)
    build_differences: dict[str, tuple[str, str]] = field(default_factory=dict)
    span_s: float = 0.0
    wall_s: float = 0.0

    @property
    def messages_compared(self) -> int:
        """Number of messages compared on all topics."""
        return self.compared.total()

    @property
    def loss(self) -> bool:
        """Whether a part of the run is missing in the file, or no message in it could be compared."""
        return bool(self.lost) or self.status is not FileStatus.COMPLETE or self.nothing

    @property
    def nothing(self) -> bool:
        """Whether no message in the file could be compared."""
        return self.messages_compared + self.digests_compared == 0

    @property
    def exit_code(self) -> int:
        """0: equal bit for bit; 1: diverged; 3: equal as far as it could be compared, with losses."""
        return 1 if self.first_divergence is not None else 3 if self.loss else 0
