#!/usr/bin/env python3
"""Draw a recording as rerun shows it, without a screen: tools/screenshot.py RUN [OUT.png] [--at SECONDS].

Needs the package with its `view` extra and a Vulkan driver; Debian's mesa-vulkan-drivers are sufficient.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from rerun.experimental import ViewerClient

from plow_twin.scene_file import load_scene
from plow_twin.view import to_rrd

SIZE = (1400, 900)
MENU = 37


def start_viewer(port: int, home: Path) -> subprocess.Popen[bytes]:
    """Start a viewer without a window that only this machine can reach; it has its own settings folder `home`."""
    rerun = Path(sys.executable).with_name("rerun")
    settings = {name: str(home) for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME")}
    environment = {**os.environ, **settings}
    subprocess.run([rerun, "analytics", "disable"], check=True, capture_output=True, env=environment)
    window = f"{SIZE[0]}x{SIZE[1]}"
    command = [str(rerun), "--headless", "--bind", "127.0.0.1", "--port", str(port), "--window-size", window]
    return subprocess.Popen(
        command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment
    )


def connect(port: int, patience_s: float = 60.0) -> ViewerClient:
    """Connect as soon as the viewer answers."""
    deadline = time.monotonic() + patience_s
    while True:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
            return client
        except Exception:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)


def bring_forward(client: ViewerClient, origins: list[str]) -> None:
    """Show the views of these origins if they are behind other tabs."""
    shown = client.get_blueprint()
    layout = shown.blueprint
    views = {
        f"view/{place.rpartition('/')[2]}": part["ViewBlueprint"]["space_origin"]
        for place, part in layout.items()
        if "ViewBlueprint" in part
    }
    for part in layout.values():
        tabs = part.get("ContainerBlueprint", {})
        chosen = [view for view in tabs.get("contents", ()) if views.get(view) in origins]
        if tabs.get("container_kind") == "Tabs" and chosen:
            tabs["active_tab"] = chosen[0]
    client.set_blueprint(layout, "recording")


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw a recording as rerun shows it, without a screen.")
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path, nargs="?", default=Path("docs/images/view.png"))
    parser.add_argument("--at", type=float, default=3.65, help="seconds after the first stamp (default: %(default)s)")
    parser.add_argument("--with", dest="others", action="append", default=[], help="a further scene (view --with)")
    parser.add_argument("--tab", action="append", default=[], help="a view to bring forward, by its origin (growth)")
    options = parser.parse_args()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        rrd, shot = Path(folder) / "run.rrd", Path(folder) / "shot.png"
        to_rrd(options.run, rrd, others={Path(file).stem: load_scene(file) for file in options.others})
        viewer = start_viewer(port, Path(folder))
        try:
            client = connect(port)
            client.open(str(rrd))
            client.set_time("run_time", duration=options.at, play_state="paused")
            bring_forward(client, options.tab)
            time.sleep(8.0)  # time for the plots to settle and the greeting to disappear
            client.save_screenshot(str(shot))
        finally:
            # the program is a child of the script that starts it, so the signal goes to the whole process group
            os.killpg(viewer.pid, signal.SIGTERM)
            viewer.wait()
        picture = Image.open(shot).convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)
        # the menu is cut off, and 256 colours are used because the picture then has a third of the bytes
        picture.crop((0, MENU, *SIZE)).quantize(256).save(options.out, optimize=True)
    print(options.out)


if __name__ == "__main__":
    main()
