"""A recording of the head's pose, to which a scene can be fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ExcessError, RecordingError
from plow_twin.model.scene import Table
from plow_twin.record.recording import read_recording
from plow_twin.record.sources import Columns, read_columns
from plow_twin.run.ensemble import Ensemble
from plow_twin.study.parameters import StudyError

Array = NDArray[np.float64]

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
    """Read the columns t, x, y, theta from a .csv, .parquet or .npz file, or the poses of a run from an .mcap file.

    An .npz file may contain `q`, shape (n, 3), instead of the three columns. Raise `StudyError` if the file cannot be
    read, or its rows cannot be used.
    """
    readers: dict[str, Callable[[Path], tuple[Array, Array, Table | None]]]
    readers = {".csv": _read_csv, ".parquet": _read_csv, ".npz": _read_npz, ".mcap": _read_mcap}
    if path.suffix not in readers:
        raise StudyError(f"recording: got {path.name!r}, expected .csv, .parquet, .npz or .mcap")
    try:
        t, q, load = readers[path.suffix](path)
    except ExcessError:
        raise
    except RecordingError as error:
        raise StudyError(str(error)) from None
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror or error}") from None
    except (ValueError, AttributeError, MemoryError, BadZipFile, EOFError) as error:  # `np.load` can raise EOFError
        raise StudyError(f"{path}: {error}") from None
    if t.ndim != 1 or q.shape != (len(t), 3) or len(t) < 2:
        raise StudyError(f"{path}: got t {t.shape} and q {q.shape}, expected (n,) and (n, 3) with n >= 2")
    bad = ~(np.isfinite(t) & np.isfinite(q).all(axis=1))
    if bad.any():
        raise StudyError(f"{path}: row {int(np.flatnonzero(bad)[0])}: expected finite numbers")
    if t[0] < 0.0 or (np.diff(t) <= 0.0).any():
        raise StudyError(f"{path}: t: got {t[0]:g} .. {t[-1]:g}, expected increasing times from 0 on [s]")
    return PoseRecording(t, q, str(path), load)


def _read_csv(path: Path) -> tuple[Array, Array, None]:
    table = read_columns(path, COLUMNS)
    return table[:, 0], table[:, 1:], None


def _read_npz(path: Path) -> tuple[Array, Array, None]:
    with np.load(path, allow_pickle=False) as archive:
        size = sum(member.file_size for member in archive.zip.infolist())
        if size > _LARGEST_ARCHIVE:
            raise ExcessError(f"{path}: unpacks to {size >> 20} MiB, expected at most {_LARGEST_ARCHIVE >> 20} MiB")
        names = list(archive.files)
        if "q" in names and "t" in names:
            return np.asarray(archive["t"], float), np.asarray(archive["q"], float), None
        if not set(COLUMNS) <= set(names):
            raise ValueError(f"got the {Columns(tuple(names))}, expected {', '.join(COLUMNS)}")
        return np.asarray(archive["t"], float), np.column_stack([archive[name] for name in COLUMNS[1:]]), None


def _read_mcap(path: Path) -> tuple[Array, Array, Table | None]:
    """Read the poses that the node published (`head_state`), and the load samples that the node used."""
    recording = read_recording(path)
    (stamps, poses), (sampled, wrench) = recording["head_state"].numpy(), recording["excitation"].numpy()
    origin = recording.header.origin_ns
    if origin is None:
        origin = int(min(np.append(sampled, stamps), default=0))
    load = Table("recorded", 1e-9 * (sampled - origin).astype(float), wrench) if len(wrench) else None
    return 1e-9 * (stamps - origin).astype(float), poses[:, :3], load
