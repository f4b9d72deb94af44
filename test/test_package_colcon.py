"""colcon build with and without links: `ros2 run` and `ros2 launch` find their files, and the programs start."""

from __future__ import annotations

import json
import shutil
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from installing import ROOT, clean_environment, copy_sources, run

from plow_twin.scene_file.presets import PRESETS

pytestmark = [pytest.mark.package, pytest.mark.timeout(300)]


@pytest.mark.parametrize("options", [[], ["--symlink-install"]], ids=["copied", "linked"])
def test_colcon_build_gives_the_layout_of_ros2_run(options: list[str], tmp_path: Path) -> None:
    colcon = Path(sys.executable).parent / "colcon"
    source = copy_sources(tmp_path / "src" / "plow_twin")
    environment = clean_environment(PATH=f"{colcon.parent}:/usr/bin:/bin", COLCON_LOG_PATH=str(tmp_path / "log"))
    run(colcon, "build", *options, "--event-handlers", "console_direct+", cwd=tmp_path, env=environment)

    prefix = tmp_path / "install" / "plow_twin"
    programs = prefix / "lib" / "plow_twin"
    assert {path.name for path in programs.iterdir()} == {
        "plow-twin",
        "plow-twin-node",
        "plow-twin-publisher",
        "twin",
        "excitation_publisher",
    }
    assert not (prefix / "bin").exists()
    assert (prefix / "share" / "ament_index" / "resource_index" / "packages" / "plow_twin").is_file()
    assert (prefix / "share" / "plow_twin" / "package.xml").is_file()
    for folder, pattern in (("config", "*.yaml"), ("launch", "*.launch.py")):
        installed = {path.name for path in (prefix / "share" / "plow_twin" / folder).glob(pattern)}
        assert installed == {path.name for path in (ROOT / folder).glob(pattern)}
        assert installed

    if not options:  # without links, the installation must not refer to the sources
        shutil.rmtree(source)
        shutil.rmtree(tmp_path / "build")

    def start(program: str, code: int = 0) -> str:
        """Start a program as `. install/setup.bash && ros2 run plow_twin <program>` does."""
        line = f". {tmp_path}/install/setup.bash && exec {programs}/{program}"
        return run("bash", "-c", line, cwd=tmp_path, env=environment, code=code)

    configuration = json.loads(start("plow-twin info --json"))["configuration"]
    assert Path(configuration).is_relative_to(source if options else prefix)
    assert json.loads(start("plow-twin info paper --json"))["numbers"][0]["key"] == "head.mass_kg"
    assert "expected_rate" in start("twin --ros-args -p expected_rate:=-1.0", code=2)


#: Files that use ROS.
OF_ROS = ("launch", "plow_twin/ros", "plow_twin/demo", "setup.py")
#: The linters of ament, with the line width and docstring style of this project.
LINTERS = (
    ("ament_xmllint", "package.xml", "config"),
    ("ament_flake8", "--linelength", "120", *OF_ROS),
    ("ament_pep257", "--convention", "numpy", "--add-ignore", "D105", "D107", "D205", "D400", "D401", "--", *OF_ROS),
)


@pytest.mark.parametrize("words", LINTERS, ids=[words[0] for words in LINTERS])
def test_the_linters_of_ament_find_nothing_in_the_files_that_ros_sees(words: tuple[str, ...]) -> None:
    if shutil.which(words[0]) is None:
        pytest.skip(f"{words[0]} is not installed")
    run(*words, cwd=ROOT)


def test_one_version_and_one_licence_everywhere() -> None:
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    version = package.findtext("version")
    name, of_setup = run(sys.executable, "setup.py", "--quiet", "--name", "--version", cwd=ROOT).split()
    assert (name, of_setup) == ("plow_twin", version)
    assert package.get("format") == "3"
    assert package.findtext("license") == "Apache-2.0"
    assert (ROOT / "LICENSE").read_text().count("END OF TERMS AND CONDITIONS") == 1
    assert set(PRESETS) <= {path.stem for path in (ROOT / "config").glob("*.yaml")}
