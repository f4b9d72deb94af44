"""Version of the package, and a fingerprint of everything that determines the exact bits of a run's results."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

#: Subpackages whose code determines the exact bits of a run's results. `estimate` is included because a twin can
#: correct its parameters by estimates during the run.
NUMERIC_SUBPACKAGES: Final = ("kernel", "model", "solve", "run", "estimate", "stream", "record")


def package_version() -> str:
    """Return the version of the installed package."""
    for name in ("plow_twin", "plow-twin"):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "not installed"


@cache
def build_fingerprint() -> Mapping[str, str]:
    """Return everything that determines the exact bits of a run: versions, processor, platform and source digest."""
    import llvmlite.binding
    import numba

    return {
        "plow_twin": package_version(),
        "source": source_digest(Path(__file__).resolve().parent),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
        "llvmlite": version("llvmlite"),
        "jit": "off" if getattr(numba.config, "DISABLE_JIT", 0) else "on",
        "cpu": llvmlite.binding.get_host_cpu_name(),
        "platform": f"{platform.system()} {platform.machine()}",
        "libc": " ".join(platform.libc_ver()),
    }


def source_digest(package: Path) -> str:
    """Return 16 hexadecimal digits, a hash of the source files in a package's numeric subpackages."""
    digest = hashlib.sha256()
    for subpackage in NUMERIC_SUBPACKAGES:
        for path in sorted((package / subpackage).rglob("*.py")):
            digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
