"""Time of an operator's steps from an empty virtual environment to a screen that shows a growing CSV file.

    python benchmark/first_screen.py [FOLDER]

The program prints the time [s] of each step of docs/how_to_screen.md as JSON.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
import venv
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PORT = 8079


def grow(path: Path, stop: threading.Event) -> None:
    """Append rows at 100 Hz to a CSV file with a load similar to the load of the preset."""
    begin, count = time.time(), 0
    with path.open("w") as file:
        file.write("t,fx,fy,m\n")
        while not stop.wait(0.01):
            while count < 100.0 * (time.time() - begin):
                phase = math.sin(0.02 * count)
                file.write(f"{begin + 0.01 * count:.3f},{3e4 * phase:.1f},{-1e4 * phase:.1f},{-4e4 * phase:.1f}\n")
                count += 1
            file.flush()


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
    took: dict[str, Any] = {}
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    # an empty cache: no other installation has compiled the code
    environment["NUMBA_CACHE_DIR"] = environment["PLOW_TWIN_CACHE"] = str(folder / "cache")

    def step(name: str) -> None:
        took[name] = round(time.monotonic() - before, 1)

    before = time.monotonic()
    venv.create(folder / "venv", with_pip=True)
    command = [folder / "venv/bin/pip", "install", "--quiet", f"{ROOT}[record,dashboard]"]
    subprocess.run(list(map(str, command)), check=True, env=environment)
    step("install_s")
    stop = threading.Event()
    writer = threading.Thread(target=grow, args=(folder / "load.csv", stop))
    writer.start()
    before = time.monotonic()
    time.sleep(0.5)
    options = ["--follow", "--scene", "paper", "--dashboard", "--listen", f"127.0.0.1:{PORT}"]
    twin = subprocess.Popen(
        list(map(str, [folder / "venv/bin/plow-twin", "live", folder / "load.csv", *options])),
        env=environment,
    )
    try:
        while True:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{PORT}/", timeout=1).close()
                break
            except OSError:
                assert twin.poll() is None
                time.sleep(0.05)
        step("page_s")
        code = (
            "import json\nfrom websockets.sync.client import connect\n"
            f"with connect('ws://127.0.0.1:{PORT}/data') as page:\n"
            "    while not (json.loads(page.recv()).get('motion') or {}).get('clearance'): pass"
        )
        subprocess.run([str(folder / "venv/bin/python"), "-c", code], check=True, timeout=60)
        step("numbers_s")
    finally:
        stop.set()
        writer.join()
        twin.terminate()
        twin.wait(20)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    took["cpu_s"] = round(used.ru_utime + used.ru_stime, 1)
    print(json.dumps(took))


if __name__ == "__main__":
    main()
