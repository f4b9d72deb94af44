"""Report of a replay."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from plow_twin.record.reader import FileStatus


@dataclass(frozen=True)
class Divergence:
    """A value that differs between recording and replay. `step` is the number of the advance, counted from 0."""

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
    """Result of a replay.

    Messages are counted by base name of the topic. The session refused the `refused` entries, and the `repeated`
    entries repeat an earlier entry. `repeated_parts` maps a file to the file that was read instead, and `foreign_parts`
    maps a file of another run to the keys of the header that differ.
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
        """Number of messages that were compared, on all topics."""
        return self.compared.total()

    @property
    def loss(self) -> bool:
        """Whether the recording is incomplete, or nothing in it could be compared."""
        return bool(self.lost) or self.status is not FileStatus.COMPLETE or self.nothing

    @property
    def nothing(self) -> bool:
        """Whether no message and no digest could be compared."""
        return self.messages_compared + self.digests_compared == 0

    @property
    def exit_code(self) -> int:
        """Exit code of the command: 0 (equal), 1 (a value differs) or 3 (equal, but the recording is incomplete)."""
        return 1 if self.first_divergence is not None else 3 if self.loss else 0
