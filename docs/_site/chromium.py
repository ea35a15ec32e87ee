"""Headless Chromium, spoken to over its debugging pipe: opens a page and tells what it asked for and complained of."""

import base64
import json
import os
import shutil
import subprocess
import tempfile
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--remote-debugging-pipe",
]  # fmt: skip
NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def program() -> str | None:
    """The browser's program, if there is one."""
    return next((result for name in NAMES if (result := shutil.which(name))), None)


class Seen(NamedTuple):
    """What a page did: the addresses that it asked for, its complaints, and how wide its content is."""

    requests: list[str]
    errors: list[str]
    width: int


class Browser:
    """A browser with one tab; use it in a `with`."""

    def __init__(self) -> None:
        self.profile = tempfile.mkdtemp(prefix="heliograph-docs-")
        (there, self.to), (self.back, here) = os.pipe(), os.pipe()

        def place() -> None:  # the browser reads from descriptor 3 and writes to 4
            reading, writing = os.dup(there), os.dup(here)
            os.dup2(reading, 3)
            os.dup2(writing, 4)

        command = [str(program()), *FLAGS, f"--user-data-dir={self.profile}"]
        self.process = subprocess.Popen(
            command, preexec_fn=place, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(there)
        os.close(here)
        self.numbers, self.buffer, self.events = count(1), b"", []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    session: str | None = None

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(10)
        os.close(self.to)
        os.close(self.back)
        shutil.rmtree(self.profile, ignore_errors=True)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Ask for something and wait for the answer; what happens meanwhile is kept in `events`."""
        number = next(self.numbers)
        message = {"id": number, "method": method, "params": parameters}
        os.write(self.to, json.dumps(message | ({"sessionId": self.session} if self.session else {})).encode() + b"\0")
        while True:
            result = self._next()
            if result.get("id") == number:
                assert "error" not in result, result["error"]
                return result["result"]
            self.events.append(result)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self.buffer:
            read = os.read(self.back, 1 << 20)
            assert read, "the browser has ended"
            self.buffer += read
        message, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(message)

    def open(self, address: str, width: int = 1200, height: int = 900) -> Seen:
        """Load a page in a window of this size, and wait until it is there."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        self.events = []
        self.call("Page.navigate", url=address)
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(self._next())
        converged = "new Promise(done => setTimeout(() => done(document.documentElement.scrollWidth), 100))"
        result = self.call("Runtime.evaluate", expression=converged, awaitPromise=True)["result"]["value"]
        return Seen(self._requests(), self._errors(), result)

    def _requests(self) -> list[str]:
        return [e["params"]["request"]["url"] for e in self.events if e["method"] == "Network.requestWillBeSent"]

    def _errors(self) -> list[str]:
        results = []
        for event in self.events:
            what = event.get("params", {})
            if event["method"] == "Runtime.exceptionThrown":
                results.append(what["exceptionDetails"]["text"])
            elif event["method"] == "Log.entryAdded" and what["entry"]["level"] == "error":
                results.append(f"{what['entry']['text']} {what['entry'].get('url', '')}")
            elif event["method"] == "Runtime.consoleAPICalled" and what["type"] == "error":
                results.append(str(what["args"]))
            elif event["method"] == "Network.loadingFailed" and not what.get("canceled"):
                results.append(what["errorText"])
        return results

    def picture(self, path: Path) -> None:
        """The whole page as a PNG."""
        data = self.call("Page.captureScreenshot", captureBeyondViewport=True)["data"]
        path.write_bytes(base64.b64decode(data))
