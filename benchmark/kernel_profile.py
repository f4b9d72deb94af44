"""Share of each kernel in the time of a run, measured by Linux `perf`.

    python benchmark/kernel_profile.py bench_kv 1e-3 [--seconds 5]

perf reads the symbols of the code that numba has compiled from /tmp/perf-<pid>.map. This program writes the file from
the object code of each library.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from numba.core import codegen

_libraries: list[tuple[Any, bytes]] = []
SHOWN = 24


def _collect() -> None:
    """Store the object code of every library that is compiled or read from the cache."""
    kind: Any = codegen.JITCodeLibrary
    fresh, cached = kind._finalize_specific, kind._unserialize.__func__

    def finalize(self: Any) -> None:
        fresh(self)
        _libraries.append((self, getattr(self, "_compiled_object", None) or b""))

    def unserialize(cls: Any, owner: Any, state: Any) -> Any:
        library = cached(cls, owner, state)
        _libraries.append((library, state[2][0] if isinstance(state[2], tuple) else b""))
        return library

    kind._finalize_specific = finalize
    kind._unserialize = classmethod(unserialize)


def _write_map() -> None:
    lines = []
    for library, code in _libraries:
        with tempfile.NamedTemporaryFile() as file:
            file.write(code)
            file.flush()
            symbols = subprocess.run(["nm", "-S", "--defined-only", file.name], capture_output=True, text=True).stdout
        engine = library._codegen._engine._ee
        for fields in (line.split() for line in symbols.splitlines()):
            if len(fields) == 4 and (address := engine.get_function_address(fields[3])):
                kernel = re.findall(r"\d+([a-z_]+)B\d", fields[3])
                lines.append(f"{address:x} {int(fields[1], 16):x} {kernel[-1] if kernel else fields[3][-40:]}\n")
    Path(f"/tmp/perf-{os.getpid()}.map").write_text("".join(lines), encoding="utf-8")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("scene")
    arguments.add_argument("tol", type=float)
    arguments.add_argument("--seconds", type=float, default=5.0)
    chosen = arguments.parse_args()
    if shutil.which("perf") is None or shutil.which("nm") is None:
        sys.exit("perf and nm are needed (Debian: linux-perf, binutils)")
    _collect()
    from work_precision import prepare_bare

    from plow_twin.scene_file import load_scene

    run = prepare_bare(load_scene(chosen.scene), 0.1, chosen.tol)
    run()
    _write_map()
    with tempfile.TemporaryDirectory() as folder:
        data = f"{folder}/perf.data"
        command = ["perf", "record", "-e", "cpu-clock", "-F", "10000", "-o", data, "-p", str(os.getpid())]
        recorder = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        end = time.perf_counter() + chosen.seconds
        while time.perf_counter() < end:
            run()
        recorder.send_signal(signal.SIGINT)
        recorder.wait()
        report = subprocess.run(
            ["perf", "report", "-i", data, "--stdio", "-F", "overhead,sym"], capture_output=True, text=True
        ).stdout
    print("\n".join([line for line in report.splitlines() if "%" in line][:SHOWN]))


if __name__ == "__main__":
    main()
