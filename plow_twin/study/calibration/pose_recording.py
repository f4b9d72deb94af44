"""A recording of the head's pose, to which a scene can be fitted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ExcessError, RecordingError
from plow_twin.model.scene import Table
from plow_twin.record.reader import RunReader
from plow_twin.record.recording import read_recording
from plow_twin.record.sources import Columns, read_columns, read_table
from plow_twin.record.times import EPOCH_S
from plow_twin.run.ensemble import Ensemble
from plow_twin.stream.journal import Loss, Reset, Restore, SetModel, SetWear
from plow_twin.study.parameters import StudyError

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

COLUMNS: Final = ("t", "x", "y", "theta")
#: Largest size [B] of the unpacked data of an archive.
_LARGEST_ARCHIVE: Final = 2**28
#: Largest number of rows of a simulated motion.
_MOST_ROWS: Final = 20_000


@dataclass(frozen=True)
class PoseRecording:
    """Recorded motion of the head.

    `t` are the times [s] on the clock of the scene, shape (n,). `q` are the poses x, y [m], theta [rad], shape (n, 3).
    """

    t: Array
    q: Array
    source: str = ""
    #: The recorded load, which replaces the loads of the scene.
    load: Table | None = None
    #: Whether the poses are those that the twin computed, and not measured poses.
    computed: bool = False
    #: Numbers of missing messages of a run by topic.
    losses: Mapping[str, int] = field(default_factory=dict)

    @property
    def output_dt(self) -> float:
        """Interval [s] of the simulated rows: the recorded interval, limited to the range t_end / 20000 to 0.01 s."""
        end = float(self.t[-1])
        step = float(np.median(np.diff(self.t))) if len(self.t) > 1 else end
        return max(min(step, 0.01), end / _MOST_ROWS)

    def sampled(self, members: Ensemble) -> Array:
        """Return the simulated poses at the recorded times, shape (m, n, 3), by cubic Hermite interpolation."""
        t = members.t
        right = np.clip(np.searchsorted(t, self.t), 1, len(t) - 1)
        left = right - 1
        h = t[right] - t[left]
        s = ((self.t - t[left]) / h)[:, None]
        h = h[:, None]
        q0, q1, v0, v1 = members.q[:, left], members.q[:, right], members.v[:, left], members.v[:, right]
        return np.asarray(
            (1.0 + 2.0 * s) * (1.0 - s) ** 2 * q0
            + s * (1.0 - s) ** 2 * h * v0
            + s**2 * (3.0 - 2.0 * s) * q1
            + s**2 * (s - 1.0) * h * v1
        )


def load_poses(path: Path) -> PoseRecording:
    """Read the columns t, x, y, theta from a .csv, .parquet or .npz file, or the poses of a run.

    An .npz file may contain `q`, shape (n, 3), instead of the three columns. A run is a folder or an .mcap file. Its
    measured poses are used if there are any, otherwise the poses that the twin computed. Raise `StudyError` if the file
    cannot be read, or its rows cannot be used.
    """
    readers: dict[str, Callable[[Path], PoseRecording]]
    readers = {".csv": _read_csv, ".parquet": _read_csv, ".npz": _read_npz, ".mcap": _read_run}
    suffix = ".mcap" if path.is_dir() else path.suffix
    if suffix not in readers:
        raise StudyError(f"recording: got {path.name!r}, expected a run, or .csv, .parquet, .npz or .mcap")
    try:
        poses = readers[suffix](path)
    except ExcessError:
        raise
    except RecordingError as error:
        raise StudyError(str(error)) from None
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror or error}") from None
    except (ValueError, AttributeError, MemoryError, BadZipFile, EOFError) as error:  # `np.load` can raise EOFError
        raise StudyError(f"{path}: {error}") from None
    t, q = poses.t, poses.q
    if t.ndim != 1 or q.shape != (len(t), 3) or len(t) < 2:
        raise StudyError(f"{path}: got t {t.shape} and q {q.shape}, expected (n,) and (n, 3) with n >= 2")
    bad = ~(np.isfinite(t) & np.isfinite(q).all(axis=1))
    if bad.any():
        raise StudyError(f"{path}: row {int(np.flatnonzero(bad)[0])}: expected finite numbers")
    if t[0] < 0.0 or (np.diff(t) <= 0.0).any():
        raise StudyError(f"{path}: t: got {t[0]:g} .. {t[-1]:g}, expected increasing times from 0 on [s]")
    if t[-1] >= EPOCH_S:
        raise StudyError(f"{path}: t: got {t[0]:.10g} .. {t[-1]:.10g}, expected the time since the scene's start [s]")
    return poses


def _read_csv(path: Path) -> PoseRecording:
    columns, _ = read_table(path)
    present = set(COLUMNS) & set(columns.names)
    if "t" in present and 2 <= len(present) < len(COLUMNS):
        expected = f"{', '.join(COLUMNS)} (plow-twin estimate uses poses with unmeasured coordinates, as empty cells)"
        raise StudyError(f"{path}: got the {columns}, expected {expected}")
    table = read_columns(path, COLUMNS)
    return PoseRecording(table[:, 0], table[:, 1:], str(path))


def _read_npz(path: Path) -> PoseRecording:
    with np.load(path, allow_pickle=False) as archive:
        size = sum(member.file_size for member in archive.zip.infolist())
        if size > _LARGEST_ARCHIVE:
            raise ExcessError(f"{path}: unpacks to {size >> 20} MiB, expected at most {_LARGEST_ARCHIVE >> 20} MiB")
        names = list(archive.files)
        if "q" in names and "t" in names:
            return PoseRecording(np.asarray(archive["t"], float), np.asarray(archive["q"], float), str(path))
        if not set(COLUMNS) <= set(names):
            raise ValueError(f"got the {Columns(tuple(names))}, expected {', '.join(COLUMNS)}")
        q = np.column_stack([archive[name] for name in COLUMNS[1:]])
        return PoseRecording(np.asarray(archive["t"], float), q, str(path))


def _read_run(path: Path) -> PoseRecording:
    """Read the poses of a run, and the load samples that the twin used."""
    _check_one_motion(path)
    recording = read_recording(path)
    sampled, wrench = _by_stamp(*recording["excitation"].numpy())
    stamps, poses = recording["head_pose"].numpy()
    whole = np.isfinite(poses).all(axis=1)
    computed = not whole.any()
    stamps, poses = _by_stamp(*recording["head_state"].numpy()) if computed else _by_stamp(stamps[whole], poses[whole])
    origin = recording.header.origin_ns
    if origin is None:
        origin = int(next((times[0] for times in (sampled, stamps) if len(times)), 0))
    load = Table("recorded", 1e-9 * (sampled - origin).astype(float), wrench) if len(wrench) else None
    during = stamps >= origin  # a sensor may send before the load begins
    t = 1e-9 * (stamps[during] - origin).astype(float)
    return PoseRecording(t, poses[during, :3], str(path), load, computed, recording.losses())


def _by_stamp(stamp_ns: Stamps, values: Array) -> tuple[Stamps, Array]:
    """Return rows in order of their stamps. Of rows with equal stamps, the newest replaces the others."""
    stamps, from_end = np.unique(stamp_ns[::-1], return_index=True)
    return stamps, values[::-1][from_end]


def _check_one_motion(path: Path) -> None:
    """Check that the motion is continuous from the initial state of the scene on, as a simulation is."""
    breaks = (Loss, Reset, Restore, SetModel, SetWear)
    found = [
        type(entry).__name__
        for batch in RunReader(path).batches(outputs=False)
        for entry in batch.entries.others.values()
        if isinstance(entry, breaks)
    ]
    if found:
        kinds = ", ".join(sorted(set(found)))
        raise StudyError(f"{path}: got {len(found)} changes of motion or model ({kinds}), expected none")
