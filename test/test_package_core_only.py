"""The package in separate environments: with numpy, scipy and numba only, and with all base dependencies."""

from __future__ import annotations

import json
import os
from pathlib import Path

import mcap_bytes
import numpy as np
import pytest
from installing import build_wheel, install, lend, lend_kernels, make_environment, run

from plow_twin.scene_file.presets import PRESETS

pytestmark = [pytest.mark.package, pytest.mark.timeout(400)]

CORE_ONLY = """
import json, sys
from importlib.metadata import distributions
from importlib.util import find_spec
import plow_twin
from plow_twin import simulate
from plow_twin import Clearance, Contact, Frame, Gravity, Harmonic, Head, Scene, Twin

for name in ("yaml", "jsonschema", "click", "rich", "mcap", "rosbags", "rerun", "rclpy"):
    assert find_spec(name) is None, name
# a ball of 1 kg falls 1 m onto a table: law and kind of load of the preset `paper`, whose kernels are compiled once
scene = Scene(
    head=Head(mass_kg=1.0, inertia_kg_m2=1.0),
    frame=Frame(width_m=1.0, height_m=1.0),
    clearance=Clearance(horizontal_m=1.0, vertical_m=2.0),
    contact=Contact("exact_restitution", stiffness=1e6, exponent=1.0, restitution=0.9),
    gravity=Gravity(9.81),
    loads=(Harmonic("along the table", (1.0, 0.0), 2.0),),
)
result = simulate(scene, 1.0, 0.1)
twin = Twin(scene)
twin.advance(1.0)
print(json.dumps({
    "file": plow_twin.__file__,
    "y": result.q[:, 1].tolist(),
    "twin": float(twin.advance(1.0).q[1]),
    "makes": sum(row["makes"] for row in result.statistics.values()),
    "distributions": sorted({d.metadata["Name"] for d in distributions()}),
}))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory, wheel: Path) -> Path:
    """Return an environment, first with the core's three libraries, later with all base dependencies."""
    python = make_environment(tmp_path_factory.mktemp("environment") / "venv")
    lend(python, "numpy", "scipy", "numba")
    install(python, "--no-deps", str(wheel))
    lend_kernels(python)
    return python


def test_model_and_twin_need_only_numpy_scipy_and_numba(environment: Path, tmp_path: Path) -> None:
    answer = json.loads(run(environment, "-c", CORE_ONLY, cwd=tmp_path))
    assert set(answer["distributions"]) <= {"numpy", "scipy", "numba", "llvmlite", "pip", "setuptools", "plow_twin"}
    assert Path(answer["file"]).is_relative_to(environment.parent.parent)
    fall = np.arange(5) * 0.1
    np.testing.assert_allclose(answer["y"][:5], -0.5 * 9.81 * fall**2, atol=1e-9)
    # in the first second, the top of the cavity touches both upper corners of the frame once
    assert answer["makes"] == 2
    assert answer["twin"] == pytest.approx(answer["y"][-1], abs=1e-8)


def test_pip_install_brings_the_command_and_the_presets(environment: Path, wheel: Path, tmp_path: Path) -> None:
    lend(environment, "click", "jsonschema", "PyYAML", "rich")
    install(environment, str(wheel))
    programs, prefix = environment.parent, environment.parent.parent
    names = {path.name for path in programs.iterdir()}
    assert {"plow-twin", "plow-twin-node", "plow-twin-publisher"} <= names and not {
        "twin",
        "excitation_publisher",
    } & names
    for name in ("twin", "excitation_publisher"):  # `ros2 run` searches this folder
        assert os.access(prefix / "lib" / "plow_twin" / name, os.X_OK)
    share = prefix / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / "plow_twin").is_file()
    assert {path.stem for path in (share / "plow_twin" / "config").glob("*.yaml")} >= set(PRESETS)
    assert (share / "plow_twin" / "package.xml").is_file()
    answer = json.loads(run(programs / "plow-twin", "simulate", "paper", "--t-end", "1", "--json", cwd=tmp_path))
    assert answer["pairs"]["top_right_top"]["max"] > 1e4
    facts = json.loads(run(programs / "plow-twin", "info", "--json", cwd=tmp_path))
    assert (facts["mcap"], facts["rclpy"]) == ("not installed", "not installed")
    output = run(programs / "plow-twin", "demo", cwd=tmp_path, code=1)
    assert "pip install 'plow_twin[ros]'" in output
    assert "pip install ./studies/paper" in run(programs / "plow-twin", "study", "paper", cwd=tmp_path, code=1)
    (tmp_path / "run.mcap").write_bytes(mcap_bytes.beginning())
    assert "pip install 'plow_twin[record]'" in run(programs / "plow-twin", "replay", "run.mcap", cwd=tmp_path, code=1)
    assert "pip install 'plow_twin[view]'" in run(programs / "plow-twin", "view", "run.mcap", cwd=tmp_path, code=1)
