"""A headless Chromium that tests can drive: pictures of a page, clicks, and what the page asked of the network."""

import base64
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-background-networking", "--no-first-run", "--window-size=1500,950"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--remote-debugging-port=0", "--remote-allow-origins=*"),
)
DEADLINE_S = 100.0


class Tab:
    """One tab of the browser.

    Attributes:
        requested: addresses that the page asked for, in order.
        errors: what its console says of errors.
    """

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._count = 0
        self.requested: list[str] = []
        self.errors: list[str] = []
        for domain in ("Network", "Page", "Runtime"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **params: object) -> Any:
        """Send a command of the DevTools protocol; returns its result."""
        self._count += 1
        self._connection.send(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            told = json.loads(self._connection.recv(timeout=DEADLINE_S))
            match told.get("method"):
                case "Network.requestWillBeSent":
                    self.requested.append(told["params"]["request"]["url"])
                case "Network.webSocketCreated":
                    self.requested.append(told["params"]["url"])
                case "Runtime.exceptionThrown":
                    self.errors.append(json.dumps(told["params"]["exceptionDetails"])[:500])
            if told.get("id") == self._count:
                return told["result"]

    def open(self, address: str) -> None:
        """Go to an address."""
        self.ask("Page.navigate", url=address)

    def run(self, script: str) -> Any:
        """The value of a script in the page."""
        return self.ask("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def wait_for(self, script: str) -> None:
        """Wait until a script in the page has a true value."""
        until = time.monotonic() + DEADLINE_S
        while not self.run(script):
            assert time.monotonic() < until, f"never true: {script}"
            time.sleep(0.2)

    def click(self, x: float, y: float) -> None:
        """Press and release the mouse."""
        self.drag((x, y), (x, y))

    def drag(self, start: tuple[float, float], end: tuple[float, float], *, shift: bool = False) -> None:
        """Move the mouse from one place to another with its button pressed."""
        keys = {"modifiers": 8 if shift else 0}
        steps = [
            ("mouseMoved", start, 0),
            ("mousePressed", start, 1),
            ("mouseMoved", end, 1),
            ("mouseReleased", end, 0),
        ]
        for kind, (x, y), held in steps:
            button = {"button": "none"} if kind == "mouseMoved" and not held else {"button": "left", "clickCount": 1}
            self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, buttons=held, **button, **keys)

    def picture(self) -> bytes:
        """The page as PNG."""
        return base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])


@contextmanager
def browsing(profile: Path) -> Iterator[Tab]:
    """A tab of a browser that has its profile in a new folder, and ends afterwards."""
    assert CHROMIUM is not None
    process = subprocess.Popen(
        [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        note, until = profile / "DevToolsActivePort", time.monotonic() + DEADLINE_S
        while not (note.is_file() and note.read_text().count("\n")):
            assert process.poll() is None and time.monotonic() < until, "the browser does not start"
            time.sleep(0.1)
        port = note.read_text().split()[0]
        with urlopen(f"http://127.0.0.1:{port}/json", timeout=DEADLINE_S) as answer:
            page = next(each for each in json.load(answer) if each["type"] == "page")
        with connect(page["webSocketDebuggerUrl"], max_size=None) as connection:
            yield Tab(connection)
    finally:
        process.terminate()
        process.wait(DEADLINE_S)
