"""Numbers read in Python and numbers in each export format equal those of the messages, in SI units."""

from __future__ import annotations

import errno
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.csv
import pyarrow.parquet
import pytest
from record_support import BASE_NS, STEP_NS, Run, paper_entries, paper_sample, record_run

import plow_twin
from plow_twin.cli.app import run as cli
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.messages import JointState
from plow_twin.record.recording import Batched, Table
from plow_twin.stream.journal import PartOfPose, Pose

COUNT = 600


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    entries = paper_entries(COUNT)
    entries[10:10] = [Pose(BASE_NS, (1e-3, 2e-3, 3e-3)), PartOfPose(BASE_NS + 1, (2,), (4e-3,))]
    return record_run(tmp_path_factory.mktemp("export") / "run", entries)


def test_tables_hold_the_numbers_of_the_messages(run: Run) -> None:
    recording = plow_twin.read_recording(run.folder)
    sent = [m for topic, m in run.outputs if topic == "/contact_peaks" and isinstance(m, JointState)]
    stamps, values = recording["contact_peaks"].numpy()
    assert stamps.tolist() == [message.stamp_ns for message in sent]
    np.testing.assert_array_equal(values, [np.r_[m.position, m.velocity, m.effort] for m in sent])
    column = recording["contact_peaks"].columns.index(f"{PAIR_NAMES[2]}/peak")
    np.testing.assert_array_equal(values[:, column], [message.effort[2] for message in sent])
    stamps, load = recording["excitation"].numpy()
    assert len(load) == COUNT and tuple(load[5]) == paper_sample(5).wrench and stamps[5] == BASE_NS + 5 * STEP_NS
    stamps, poses = recording["head_pose"].numpy()
    np.testing.assert_array_equal(poses, [[1e-3, 2e-3, 3e-3], [np.nan, np.nan, 4e-3]])
    assert recording.scene.head.mass_kg == 2430.0
    with pytest.raises(KeyError, match="expected one of excitation, head_pose"):
        recording["forces"]


def test_losses_of_a_recording_are_known_after_one_reading_of_its_tables(run: Run, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    whole = next(run.folder.glob("*.mcap")).read_bytes()
    cut.write_bytes(whole[: len(whole) * 3 // 4])
    alone, read = plow_twin.read_recording(cut), plow_twin.read_recording(cut)
    read["contact_peaks"].numpy()
    cut.unlink()  # the file is no longer needed: it is not read a second time
    assert read.losses()
    cut.write_bytes(whole[: len(whole) * 3 // 4])
    assert alone.losses() == read.losses()


def test_numpy_pandas_and_arrow_have_the_same_numbers(run: Run) -> None:
    table = plow_twin.read_recording(run.folder)["head_state"]
    stamps, values = table.numpy()
    frame, arrow = table.pandas(), table.arrow()
    assert list(frame.columns) == list(table.columns) == arrow.column_names[1:]
    np.testing.assert_array_equal(frame.to_numpy(), values)
    np.testing.assert_array_equal(np.stack([column.to_numpy() for column in arrow.columns[1:]], axis=1), values)
    assert frame.index[0] == pd.Timestamp(stamps[0], tz="UTC")


@pytest.mark.parametrize("kind", ["csv", "parquet", "npz"])
def test_an_export_equals_the_recording_and_overwrites_nothing(
    kind: str, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / ("run.npz" if kind == "npz" else "tables")
    assert cli(["export", str(run.folder), "--to", kind, "--out", str(out), "--quiet"]) == 0
    recording = plow_twin.read_recording(run.folder)
    for name in recording.names:
        stamps, values = recording[name].numpy()
        if not len(stamps):  # this run did not follow its machine, so these tables are empty
            assert name in ("force_intervals", "peak_intervals") and not (out / f"{name}.{kind}").exists()
            continue
        if kind == "npz":
            with np.load(out) as arrays:
                np.testing.assert_array_equal(arrays[f"{name}/stamp_ns"], stamps)
                np.testing.assert_array_equal(arrays[f"{name}/values"], values)
                assert tuple(arrays[f"{name}/columns"]) == recording[name].columns
            continue
        file = out / f"{name}.{kind}"
        table = pyarrow.csv.read_csv(file) if kind == "csv" else pyarrow.parquet.read_table(file)
        assert table.column_names == ["stamp", *recording[name].columns]
        read = np.stack([column.to_numpy().astype(float) for column in table.columns[1:]], axis=1)
        np.testing.assert_array_equal(read, values)
        np.testing.assert_array_equal(table["stamp"].to_numpy().astype("datetime64[ns]").astype(np.int64), stamps)
    assert cli(["export", str(run.folder), "--to", kind, "--out", str(out), "--quiet"]) == 2
    assert "exists already" in capsys.readouterr().err


def test_an_export_reports_a_truncated_recording_and_an_unwritable_folder(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(run.file.read_bytes()[: run.file.stat().st_size // 2])
    assert cli(["export", str(cut), "--to", "csv", "--out", str(tmp_path / "tables"), "--quiet"]) == 3
    assert "truncated" in capsys.readouterr().err and (tmp_path / "tables" / "excitation.csv").is_file()
    read, calls = Table.arrow_batch, itertools.count()

    def full(table: Table, part: Batched) -> Any:
        if next(calls) > 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        return read(table, part)

    monkeypatch.setattr(Table, "arrow_batch", full)
    assert cli(["export", str(run.folder), "--to", "parquet", "--out", str(tmp_path / "none"), "--quiet"]) == 1
    assert "cannot be written: No space left" in capsys.readouterr().err
    # no incomplete file remains, because it would seem complete
    assert not list((tmp_path / "none").iterdir())
    monkeypatch.undo()
    (tmp_path / "file").write_text("")
    assert cli(["export", str(run.folder), "--to", "csv", "--out", str(tmp_path / "file" / "x"), "--quiet"]) == 1
    assert "cannot be written" in capsys.readouterr().err
