"""A headless Chromium, driven by its own DevTools protocol, for tests of pages."""

from __future__ import annotations

import base64
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

TIMEOUT = 120.0
"""Seconds that anything may take on a loaded machine."""


def missing() -> str:
    """Why there can be no tests in a browser; the empty string if there can."""
    try:
        import websockets.sync.client  # noqa: F401
    except ImportError:
        return "needs websockets, which comes with d4orm-env[viz]"
    return "" if executable() else "needs Chromium; on Debian: apt-get install chromium"


def executable() -> str | None:
    """Where Chromium is."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Page:
    """The one page of a browser.

    Attributes:
        complaints: What the console has said of errors, and exceptions that nobody caught.
        requests: Addresses that it has asked for.
    """

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect

        self._socket = connect(address, max_size=None, open_timeout=TIMEOUT)
        self._number = 0
        self.complaints: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the protocol, and its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=TIMEOUT))
            if message.get("id") == self._number:
                assert "error" not in message, message["error"]
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        kind, content = message.get("method"), message.get("params", {})
        if kind == "Runtime.exceptionThrown":
            details = content["exceptionDetails"]
            self.complaints.append(details.get("exception", {}).get("description") or details["text"])
        elif kind == "Runtime.consoleAPICalled" and content["type"] in ("error", "assert"):
            self.complaints.append(
                " ".join(str(part.get("value", part.get("description"))) for part in content["args"])
            )
        elif kind == "Log.entryAdded" and content["entry"]["level"] == "error":
            self.complaints.append(f"{content['entry']['text']} {content['entry'].get('url', '')}")
        elif kind == "Network.requestWillBeSent":
            self.requests.append(content["request"]["url"])

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of JavaScript, waited for if it is a promise."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def until(self, expression: str) -> Any:
        """Wait for an expression to become true, and return it."""
        end = time.monotonic() + TIMEOUT
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < end, f"{expression} is still {value!r}; {self.complaints}"
            time.sleep(0.05)
        return value

    def open(self, address: str) -> None:
        """Go to an address, and wait until it is loaded; complaints of the page before are forgotten."""
        self.complaints.clear()
        self.call("Page.navigate", url=address)
        begin = address if address.startswith(("file:", "about:")) else "/".join(address.split("/")[:3])
        self.until(f"location.href.startsWith({begin!r}) && document.readyState === 'complete'")

    def offline(self, offline: bool = True) -> None:
        """Take the network away, or give it back."""
        rates = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        self.call("Network.emulateNetworkConditions", offline=offline, **rates)

    def look(self, width: int = 1200, height: int = 800, dark: bool = False) -> None:
        """Choose the window's size and the scheme of colours."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def press(self, key: str) -> None:
        """Press a key that writes one letter, or a named one."""
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def mouse(self, kind: str, x: float, y: float, shift: bool = False, held: bool = True) -> None:
        """``"Pressed"``, ``"Moved"`` or ``"Released"`` at a place, with the left button, if held, and perhaps Shift."""
        button = {"button": "left", "buttons": 1, "clickCount": int(kind != "Moved")} if held else {"button": "none"}
        self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, modifiers=8 * shift, **button)

    def drag(self, start: tuple[float, float], end: tuple[float, float], moves: int = 10, shift: bool = False) -> None:
        """Press at a place, move, and let go at another, perhaps with the Shift key held."""
        self.mouse("Moved", *start, shift, held=False)
        # The page looks what the mouse is over when it draws.
        self.frames(8)
        self.mouse("Pressed", *start, shift)
        for move in range(1, moves + 1):
            x, y = (a + move / moves * (b - a) for a, b in zip(start, end))
            self.mouse("Moved", x, y, shift)
            self.frames(1)
        self.mouse("Released", *end, shift)

    def frames(self, count: int) -> None:
        """Wait until the page has drawn so many times."""
        for _ in range(count):
            self.evaluate("new Promise((done) => requestAnimationFrame(() => done(true)))")

    def screenshot(self, path: Path) -> None:
        """Write what is seen as a PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        self._socket.close()


@contextmanager
def browser(folder: Path) -> Iterator[Page]:
    """A browser with one empty page, whose profile is in a folder; no process is left at the end."""
    program = executable()
    assert program is not None
    options = [
        "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage",
        "--remote-debugging-port=0", f"--user-data-dir={folder}", "about:blank",
    ]  # fmt: skip
    with (folder / "log.txt").open("wb") as log:
        process = subprocess.Popen([program, *options], stdout=log, stderr=log, start_new_session=True)
        try:
            page = Page(_address(folder, process))
            try:
                yield page
            finally:
                page.close()
        finally:
            # It has processes of its own, which would go on writing into the folder.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _address(folder: Path, process: subprocess.Popen[bytes]) -> str:
    """Where the page is debugged, once the browser has written its port."""
    from urllib.request import urlopen

    end = time.monotonic() + TIMEOUT
    while time.monotonic() < end:
        assert process.poll() is None, (folder / "log.txt").read_text(errors="replace")
        try:
            port = (folder / "DevToolsActivePort").read_text().split()[0]
            with urlopen(f"http://127.0.0.1:{port}/json/list", timeout=5) as answer:
                pages = [entry for entry in json.load(answer) if entry["type"] == "page"]
            if pages:
                return str(pages[0]["webSocketDebuggerUrl"])
        except (OSError, IndexError):
            pass
        time.sleep(0.1)
    raise AssertionError("Chromium did not start")
