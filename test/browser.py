"""A headless Chromium or Firefox that opens a page, takes a picture of it and reads its console."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from waiting import until
from websockets.sync.client import ClientConnection, connect

#: Path of Chromium, or None if it is not installed.
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
#: Options with which Chromium draws WebGL without a graphics card.
_OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--remote-debugging-port=0",
    "--window-size=700,450",
)  # fmt: skip


class Page:
    """An open page. `requests` are the addresses that it requests, and `errors` are its error messages."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._number = 0
        self.requests: list[str] = []
        self.errors: list[str] = []
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the browser and return its answer. Events that arrive before the answer are stored."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=60.0))
            if message.get("id") == self._number:
                assert "error" not in message, message
                result: dict[str, Any] = message["result"]
                return result
            self._note(message)

    def open(self, url: str) -> None:
        """Open an address and wait until the page has been loaded."""
        self.call("Page.navigate", url=url)
        while True:
            message = json.loads(self._socket.recv(timeout=60.0))
            self._note(message)
            if message.get("method") == "Page.loadEventFired":
                return

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("method") == "Network.requestWillBeSent":
            self.requests.append(message["params"]["request"]["url"])
        elif message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(str(message["params"]["exceptionDetails"]))
        elif message.get("method") == "Log.entryAdded":
            entry = message["params"]["entry"]
            if entry["level"] == "error" and entry["source"] != "network":  # network errors are recorded in `requests`
                self.errors.append(str(entry))

    def evaluate(self, expression: str) -> Any:
        answer = self.call("Runtime.evaluate", expression=expression)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def picture(self) -> bytes:
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])


@contextmanager
def page(folder: Path, url: str) -> Iterator[Page]:
    """Open a page in a separate browser with its files in `folder`."""
    assert CHROMIUM is not None
    command = [CHROMIUM, *_OPTIONS, f"--user-data-dir={folder}", "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        place = folder / "DevToolsActivePort"
        until(lambda: process.poll() is not None or (place.exists() and "\n" in place.read_text()), "an answer")
        port = place.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
            target = next(entry for entry in json.load(answer) if entry["type"] == "page")
        with connect(target["webSocketDebuggerUrl"], max_size=None) as socket:
            opened = Page(socket)
            opened.open(url)
            yield opened
    finally:
        process.terminate()
        process.wait(20)


#: Path of Firefox, or None if it is not installed.
FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")


class FirefoxPage:
    """An open page of a headless Firefox, controlled by WebDriver BiDi. `errors` are the exceptions of its scripts."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._number = 0
        self.errors: list[str] = []
        self._call("session.new", capabilities={})
        self._call("session.subscribe", events=["log.entryAdded"])
        self._context = self._call("browsingContext.getTree")["contexts"][0]["context"]

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=60.0))
            if message.get("id") == self._number:
                assert message["type"] == "success", message
                result: dict[str, Any] = message["result"]
                return result
            if message.get("method") == "log.entryAdded" and message["params"]["level"] == "error":
                self.errors.append(str(message["params"]["text"]))

    def open(self, url: str) -> None:
        """Open an address and wait until the page has been loaded."""
        self._call("browsingContext.navigate", context=self._context, url=url, wait="complete")

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression in the page: text, number or truth value."""
        target = {"context": self._context}
        answer = self._call("script.evaluate", expression=expression, target=target, awaitPromise=False)
        assert answer["type"] == "success", answer
        return answer["result"].get("value")

    def picture(self) -> bytes:
        return base64.b64decode(self._call("browsingContext.captureScreenshot", context=self._context)["data"])


@contextmanager
def firefox_page(folder: Path, url: str) -> Iterator[FirefoxPage]:
    """Open a page in a separate Firefox with its files in `folder`."""
    assert FIREFOX is not None
    folder.mkdir(exist_ok=True)
    options = ["--headless", "--no-remote", "--profile", str(folder), "--remote-debugging-port", "0"]
    process = subprocess.Popen(
        [FIREFOX, *options, "--window-size", "1500,1000"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ, "HOME": str(folder)},
    )  # fmt: skip
    try:
        place = folder / "WebDriverBiDiServer.json"
        until(lambda: process.poll() is not None or (place.exists() and place.read_text().endswith("}")), "an answer")
        server = json.loads(place.read_text())
        with connect(f"ws://{server['ws_host']}:{server['ws_port']}/session", max_size=None) as socket:
            opened = FirefoxPage(socket)
            opened.open(url)
            yield opened
    finally:
        process.terminate()
        process.wait(20)
