"""Permitted imports between the subpackages, and the libraries that each subpackage may import."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import plow_twin
from plow_twin.build import NUMERIC_SUBPACKAGES
from plow_twin.kernel.compiler import KERNEL_FOLDERS

PACKAGE = Path(__file__).resolve().parent.parent / "plow_twin"

SOLVER = {"errors", "kernel", "model", "solve"}
CORE = SOLVER | {"run"}
#: Subpackages that each subpackage may import.
SUBPACKAGES = {
    "errors": set(),
    "build": set(),
    "access": {"errors"},
    "kernel": {"errors"},
    "model": {"errors", "kernel"},
    "scene_file": {"errors", "model"},
    "solve": {"errors", "kernel", "model"},
    "run": SOLVER,
    "stream": CORE,
    "estimate": CORE | {"stream"},
    "record": CORE | {"build", "scene_file", "stream", "estimate"},
    "view": CORE | {"scene_file", "stream", "estimate", "record"},
    "study": CORE | {"build", "scene_file", "stream", "estimate", "record", "view"},
    "live": CORE | {"access", "scene_file", "stream", "estimate", "record"},
    "ros": CORE | {"build", "scene_file", "stream", "estimate", "record", "live"},
    "dashboard": CORE | {"access", "scene_file", "stream", "record", "live", "ros"},
    "telemetry": CORE | {"access", "scene_file", "stream", "record", "live", "ros", "dashboard"},
    "demo": CORE | {"scene_file", "stream", "record", "view", "live", "ros"},
    "cli": CORE
    | {"build", "scene_file", "stream", "estimate", "record", "view", "study", "live", "ros", "dashboard", "demo"}
    | {"access", "telemetry"},
    "__init__": CORE | {"scene_file", "record", "view"},
    "__main__": {"cli"},
}
#: Parts of scipy that must be imported lazily. numba always imports the package scipy itself.
SCIPY = ("scipy.linalg", "scipy.optimize", "scipy.special")
MESSAGES = {
    f"{name}_msgs"
    for name in ("diagnostic", "geometry", "lifecycle", "nav", "rosgraph", "sensor", "std", "visualization", "tf2")
}
#: Libraries other than numpy that each subpackage may import.
LIBRARIES = {
    "build": {"numba", "llvmlite"},
    "kernel": {"numba", "llvmlite"},
    "model": {"scipy"},
    "solve": {"scipy"},
    "estimate": {"scipy"},
    # matplotlib is imported only for the type of `Result.plot`; a test checks that it is not loaded at run time
    "run": {"matplotlib"},
    "scene_file": {"yaml", "jsonschema", "pyarrow"},
    "record": {
        "mcap",
        "rosbags",
        "numba",
        "llvmlite",
        "lz4",
        "zstandard",
        "isal",
        "yaml",
        "pandas",
        "pyarrow",
    },
    "view": {"rerun", "matplotlib"},
    "study": {
        "scipy",
        "yaml",
        "jsonschema",
        "matplotlib",
        "pyarrow",
        "distributed",
        "jinja2",
        "rerun",
        "rainflow",
    },
    "live": {"scipy", "yaml", "paho", "asyncua", "cryptography", "prometheus_client"},
    "ros": {"rclpy", "rcl_interfaces", "builtin_interfaces", "std_srvs", "ament_index_python", *MESSAGES},
    "dashboard": {"starlette", "uvicorn", "rclpy", "rcl_interfaces", "std_srvs", *MESSAGES},
    "telemetry": {"asyncua", "cryptography", "google", "influxdb_client", "urllib3"},
    "demo": {"rclpy", "rich", *MESSAGES},
    "cli": {"click", "rich"},
}


#: The study of the paper imports the library. Only the placeholder of its command imports the study.
PAPER_STUDY = PACKAGE.parent / "studies" / "paper" / "plow_twin_paper"
PAPER_MAY_IMPORT = CORE | {"build", "scene_file", "stream", "record", "view", "study", "cli"}


def _modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


@cache
def _statements(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """Return every import of a file, including lazy imports."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return [node for node in nodes if isinstance(node, (ast.Import, ast.ImportFrom))]


def _imports(path: Path) -> Iterator[str]:
    for node in _statements(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        else:
            assert node.level == 0, f"{path}: a relative import"
            if node.module == "plow_twin":
                yield from (f"plow_twin.{alias.name}" for alias in node.names)
            else:
                yield node.module or ""


@pytest.mark.parametrize("path", _modules(), ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_imports_point_one_way(path: Path) -> None:
    subpackage = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    subpackages = {name.split(".")[1] for name in _imports(path) if name.startswith("plow_twin.")} - {subpackage}
    forbidden = subpackages - SUBPACKAGES[subpackage]
    assert not forbidden, f"{subpackage} must not import {sorted(forbidden)}"
    libraries = {name.split(".")[0] for name in _imports(path)} - {"plow_twin", "numpy"} - sys.stdlib_module_names
    allowed = LIBRARIES.get(subpackage, set())
    assert libraries <= allowed, f"{subpackage} must not import {sorted(libraries - allowed)}"


def test_the_study_of_the_paper_imports_the_library_and_the_library_does_not_import_it() -> None:
    for path in sorted(PAPER_STUDY.glob("*.py")):
        used = {name.split(".")[1] for name in _imports(path) if name.startswith("plow_twin.")}
        assert used <= PAPER_MAY_IMPORT, path
    assert not [path for path in _modules() if any(name.startswith("plow_twin_paper") for name in _imports(path))]


def _module_name(path: Path) -> str:
    name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    return name.removesuffix(".__init__")


def _module_imports(path: Path, modules: set[str]) -> set[str]:
    """Return the modules of the package that a module imports, including lazy and type-checking imports."""
    imported = set()
    for node in _statements(path):
        if isinstance(node, ast.Import):
            names = [[alias.name] for alias in node.names]
        else:
            # the statement is either `from folder import module` or `from module import name`
            names = [[f"{node.module}.{alias.name}", node.module or ""] for alias in node.names]
        imported |= {
            next(name for name in candidates if name in modules) for candidates in names if {*candidates} & modules
        }
    return imported - {_module_name(path)}


def test_no_import_is_circular() -> None:
    modules = {_module_name(path) for path in _modules()}
    graph = {_module_name(path): _module_imports(path, modules) for path in _modules()}
    assert graph["plow_twin.cli.simulate"] > {"plow_twin.run.simulate", "plow_twin.cli.console"}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the cycle


def test_the_cache_stamp_and_the_build_fingerprint_cover_every_kernel() -> None:
    """After a change in an uncovered kernel, old code would be loaded from the cache without a new fingerprint."""
    compiled = [path for path in _modules() if "plow_twin.kernel.compiler.kernel" in _imported_names(path)]
    assert len(compiled) > 10
    subpackages = {path.relative_to(PACKAGE).parts[0] for path in compiled}
    assert subpackages <= {*KERNEL_FOLDERS} and {*KERNEL_FOLDERS} <= {*NUMERIC_SUBPACKAGES}
    assert all((PACKAGE / subpackage).is_dir() for subpackage in (*KERNEL_FOLDERS, *NUMERIC_SUBPACKAGES))
    # one file compiles without the stamp; it calls no kernel of another file, so numba detects its changes
    direct = {path.relative_to(PACKAGE).as_posix() for path in _modules() if "numba" in {*_imports(path)}}
    assert {name for name in direct if not name.startswith("kernel/")} == {"build.py"}
    unstamped = [path for path in _modules() if "plow_twin.kernel.compiler.kept" in _imported_names(path)]
    assert unstamped == [PACKAGE / "record/template.py"]
    modules = {_module_name(path) for path in compiled}
    assert not _module_imports(PACKAGE / "record/template.py", modules) and "record" in NUMERIC_SUBPACKAGES


def _imported_names(path: Path) -> set[str]:
    nodes = (node for node in _statements(path) if isinstance(node, ast.ImportFrom))
    return {f"{node.module}.{alias.name}" for node in nodes for alias in node.names}


@pytest.mark.parametrize(
    ("statement", "unwanted"),
    [
        (
            "from plow_twin import Twin, simulate",
            {*SCIPY, "jsonschema", "click", "rich", "mcap", "rosbags", "rerun", "rclpy"},
        ),
        (
            "import plow_twin.stream.session",
            {*SCIPY, "jsonschema", "click", "rich", "mcap", "rosbags", "rerun", "rclpy"},
        ),
        (
            "from plow_twin import Twin, load_scene; Twin(load_scene('paper')).advance(0.01)",
            {*SCIPY, "click", "rich", "mcap", "rosbags", "rerun", "rclpy"},
        ),
        # a help text needs no solver
        ("import plow_twin.cli\ntry: plow_twin.cli.main(['-h'])\nexcept SystemExit: pass", {"numba"}),
        ("import plow_twin.cli.app, plow_twin.record.replay", {*SCIPY, "mcap", "rosbags", "rerun", "rclpy"}),
        (
            "import plow_twin.cli.live, plow_twin.live.front",
            {
                *SCIPY,
                "mcap",
                "rosbags",
                "rerun",
                "rclpy",
                "paho",
                "asyncua",
                "prometheus_client",
                "starlette",
                "uvicorn",
                "plow_twin.dashboard",
            },
        ),
        # the server of the screen needs no numeric library
        ("import numpy, plow_twin.dashboard.server", {"numba", "scipy", "plow_twin.model.scene", "plow_twin.live"}),
        ("import plow_twin.ros.node", {*SCIPY, "mcap", "rosbags", "rerun"}),
        (
            "import plow_twin.run.twin, plow_twin.cli.app, plow_twin.study",
            {"matplotlib", "pyarrow", "distributed", "jinja2", "rerun"},
        ),
    ],
)
def test_heavy_libraries_are_imported_where_they_are_used(statement: str, unwanted: set[str]) -> None:
    code = f"{statement}\nimport sys\nprint(*sys.modules)"
    output = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    loaded = set(output.split())
    assert "numpy" in loaded
    assert not unwanted & loaded


def test_every_public_name_is_found_and_imported_on_first_use() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    names = {alias.name for node in typed.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert {name for name in dir(plow_twin) if not name.startswith("_")} >= names
    for name in names:
        assert getattr(plow_twin, name) is not None
    # these names need optional libraries, so they are not in `__all__`
    assert set(plow_twin.__all__) == names - {"Recording", "read_recording", "plot_motion"}
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        plow_twin.nonsense  # noqa: B018
    code = (
        "import plow_twin, plow_twin.cli, sys\nprint(*(name for name in sys.modules if name.startswith('plow_twin')))"
    )
    output = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert output.split() == ["plow_twin", "plow_twin.cli"]


@pytest.mark.parametrize("module", ["numpy", "numba.core.types", "plow_twin.kernel.compiler", "click", "rich.table"])
def test_ctrl_c_during_the_imports_is_one_line(module: str) -> None:
    code = f"""
import os, signal, sys
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
from plow_twin.cli import main
main(["info"])
"""
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (completed.returncode, completed.stdout, completed.stderr) == (1, "", "plow-twin: interrupted\n")
