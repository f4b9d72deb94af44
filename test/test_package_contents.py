"""Contents of wheel and sdist: everything that the package needs, without the tests."""

from __future__ import annotations

import sys
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from installing import ROOT, build_wheel, copy_sources, run

pytestmark = [pytest.mark.package, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def version() -> str:
    return run(sys.executable, "setup.py", "--quiet", "--version", cwd=ROOT).strip()


def test_a_wheel_holds_package_data_executables_and_metadata(tmp_path: Path, version: str) -> None:
    with zipfile.ZipFile(build_wheel(tmp_path)) as wheel:
        names = set(wheel.namelist())
        metadata = message_from_bytes(wheel.read(f"plow_twin-{version}.dist-info/METADATA"))
        scripts = wheel.read(f"plow_twin-{version}.dist-info/entry_points.txt").decode()
        data = f"plow_twin-{version}.data/data/"
        twin = wheel.getinfo(f"{data}lib/plow_twin/twin")
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "plow_twin").rglob("*.py")}
    assert modules <= names and "plow_twin/py.typed" in names
    page = ROOT / "plow_twin" / "dashboard" / "page"
    assert {f"plow_twin/dashboard/page/{path.name}" for path in page.iterdir()} <= names
    config = [path for path in (ROOT / "config").rglob("*.*") if path.suffix != ".service"]
    assert {f"{data}share/plow_twin/{path.relative_to(ROOT)}" for path in config} <= names
    assert {f"{data}share/plow_twin/launch/twin.launch.py", f"{data}share/plow_twin/package.xml"} <= names
    folders = {name.partition("/")[0] for name in names}
    assert folders == {"plow_twin", f"plow_twin-{version}.dist-info", f"plow_twin-{version}.data"}
    assert (twin.external_attr >> 16) & 0o111
    assert sorted(line.partition(" =")[0] for line in scripts.splitlines() if "=" in line) == [
        "plow-twin", "plow-twin-node", "plow-twin-publisher"
    ]  # fmt: skip
    assert metadata["Description-Content-Type"] == "text/markdown" and "# plow_twin" in metadata.get_payload()
    # pip refuses to install for another version and names this requirement
    assert metadata["Requires-Python"] == ">=3.11,<3.13"
    assert any("Python :: 3.12" in classifier for classifier in metadata.get_all("Classifier"))
    assert any(name.endswith("LICENSE") for name in names)


def test_a_source_distribution_is_enough_to_build_the_same_wheel(tmp_path: Path, version: str) -> None:
    source = copy_sources(tmp_path / "source")
    build = (sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path)
    run(*build, "--sdist", ".", cwd=source)
    with tarfile.open(tmp_path / f"plow_twin-{version}.tar.gz") as archive:
        archive.extractall(tmp_path, filter="data")
    unpacked = tmp_path / f"plow_twin-{version}"
    assert not any((unpacked / name).exists() for name in ("test", "docs", "studies", "benchmark"))
    run(*build, "--wheel", ".", cwd=unpacked)
    with (
        zipfile.ZipFile(build_wheel(tmp_path / "direct")) as direct,
        zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as built,
    ):
        assert sorted(direct.namelist()) == sorted(built.namelist())


def test_the_citation_names_the_version(version: str) -> None:
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n{version} (" in (ROOT / "CHANGELOG.rst").read_text()
