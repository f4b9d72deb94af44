"""CPU time of the operator's screen in a twin at 1 kHz and in its server, by the number of open pages.

python benchmark/screen_load.py [SECONDS]
"""

from __future__ import annotations

import json
import subprocess
import sys
import time

import numpy as np
from live_load import cpu_s

from plow_twin.dashboard.access import PageAccess
from plow_twin.dashboard.facts import facts_of
from plow_twin.dashboard.screen import Screen
from plow_twin.scene_file import load_scene
from plow_twin.solve.state import ROW
from plow_twin.stream.outputs import NOTHING, Published

READER = """
import sys, threading
from websockets.sync.client import connect
def read():
    with connect(sys.argv[1], max_size=None) as page:
        for message in page: pass
for _ in range(int(sys.argv[2])): threading.Thread(target=read, daemon=True).start()
threading.Event().wait()
"""


def measured(pages: int, seconds: float) -> dict[str, float]:
    rows = np.zeros(1, ROW)
    with Screen(PageAccess("127.0.0.1", 0), facts_of(load_scene("paper"), {}, "")) as screen:
        screen.feed._load = lambda: np.zeros(3)
        address = screen.url.replace("http", "ws") + "data"
        readers = subprocess.Popen([sys.executable, "-c", READER, address, str(pages)])
        time.sleep(3.0)
        before, spent, begin, count = cpu_s(screen.process.pid), 0, time.monotonic(), 0
        while (now := time.monotonic() - begin) < seconds:
            while count < 1000.0 * now:
                published = Published(rows.copy(), NOTHING.slow)
                published.rows["stamp_ns"] = 10**18 + 1_000_000 * count
                started = time.thread_time_ns()
                screen.feed.publication(published)
                if count % 100 == 0:
                    screen.feed.turn()
                spent += time.thread_time_ns() - started
                count += 1
            time.sleep(1e-3)
        server = cpu_s(screen.process.pid) - before
        readers.kill()
        readers.wait()
        return {
            "pages": pages,
            "twin_percent": round(1e-7 * spent / seconds, 2),
            "server_percent": round(100.0 * server / seconds, 2),
            "not_taken": screen.feed.not_taken,
        }


if __name__ == "__main__":
    for number in (0, 1, 10):
        print(json.dumps(measured(number, float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)), flush=True)
