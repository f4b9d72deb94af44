"""Recordings read by other programs: the JavaScript reader of MCAP, and the loader of rerun."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from record_support import Run, paper_sample, record_run
from rerun.chunk import RrdReader

from plow_twin.record.messages import JointState
from plow_twin.record.reader import RunReader

COUNT = 1000
PACKAGES = ("@mcap/core@2.2.2", "@mcap/support@1.1.0")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return record_run(tmp_path_factory.mktemp("runs") / "run", map(paper_sample, range(COUNT)))


def test_mcap_s_own_reader_in_javascript_finds_every_message(run: Run, tmp_path: Path) -> None:
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node and npm are not installed")
    script = tmp_path / "read_mcap.mjs"
    script.write_bytes(Path(__file__).with_name("read_mcap.mjs").read_bytes())
    install = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", *PACKAGES]
    completed = subprocess.run(install, cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False)
    if completed.returncode != 0:
        pytest.skip("npm's registry does not answer")
    command = ["node", str(script), str(run.file)]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, timeout=100, check=True).stdout)
    reader = RunReader(run.folder)
    assert [*reader.batches()]
    assert found["counts"] == dict(reader.counts) and found["counts"]["/contact_forces"] == COUNT
    # the script also reads the file from start to end and compares all checksums
    assert found["inOrder"] and found["done"] and found["streamed"] == reader.counts.total()
    assert found["profile"] == "ros2" and found["metadata"] == ["plow_twin", "plow_twin_loss"]
    assert "sensor_msgs/msg/JointState ros2msg" in found["schemas"]


def test_rerun_s_loader_plots_the_numbers_under_their_names(run: Run, tmp_path: Path) -> None:
    command = [str(Path(sys.executable).with_name("rerun")), "mcap", "convert", str(run.file), "-o"]
    subprocess.run([*command, str(tmp_path / "out.rrd")], capture_output=True, timeout=100, check=True)
    rows: list[list[float]] = []
    names: set[str] = set()
    for chunk in RrdReader(str(tmp_path / "out.rrd")).stream():
        if chunk.entity_path == "/contact_forces/effort":
            batch = chunk.to_record_batch()
            columns = batch.schema.names
            if "Scalars:scalars" in columns:
                rows += batch.column(columns.index("Scalars:scalars")).to_pylist()
            if "SeriesLines:names" in columns:
                names.update(*filter(None, batch.column(columns.index("SeriesLines:names")).to_pylist()))
    sent = [message for topic, message in run.outputs if topic == "/contact_forces" and isinstance(message, JointState)]
    np.testing.assert_array_equal(rows, [message.effort for message in sent])
    assert names == set(sent[0].name)
