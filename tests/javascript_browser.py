"""A real browser without a screen, spoken to over its debugging port. Shell (processes, sockets).

Without Chromium every test that needs it is skipped, and says so.
"""

import base64
import itertools
import json
import os
import shutil
import signal
import subprocess
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from tests.fixtures.links import until

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_START_S = 30.0
_ANSWER_S = 15.0


def chromium() -> str:
    """The browser's path; skips the test where there is none."""
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip("the viewer is not tried in a browser: no Chromium here (apt-get install chromium)")
    return found


class Browser:
    """`with Browser(folder, "http://127.0.0.1:8765/") as page`: a page of its own, ended at the end."""

    def __init__(self, folder: Path, url: str) -> None:
        self._profile = folder / "chromium"
        self._command = [
            chromium(), "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--disable-background-networking", "--disable-sync", "--window-size=760,1000", "--remote-debugging-port=0",
            "--remote-allow-origins=*", f"--user-data-dir={self._profile}", url,
        ]  # fmt: skip
        self._log = (folder / "chromium.log").open("wb")
        self._url, self._ending = url, ExitStack()
        self._numbers = itertools.count(1)
        self.errors: list[str] = []
        """What the page threw or complained of."""

    def __enter__(self) -> "Browser":
        self.process = subprocess.Popen(self._command, stdout=self._log, stderr=self._log, start_new_session=True)
        try:
            self._speech = self._opened()
            self._call("Runtime.enable")
            self._call("Page.enable")
            # At first it is blank, and complete as such.
            loaded = f"location.href == {json.dumps(self._url)} && document.readyState == 'complete'"
            assert until(lambda: self.run(loaded), _START_S), "the page does not load"
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        self._ending.close()
        os.killpg(self.process.pid, signal.SIGKILL)  # its helpers too; the profile is the test's
        self.process.wait(10)
        self._log.close()

    def _opened(self) -> ClientConnection:
        """The page's own debugging connection, once the page is there."""
        told = self._profile / "DevToolsActivePort"
        assert until(lambda: told.exists() and told.read_text().count("\n"), _START_S), "the browser does not start"
        port = told.read_text().split()[0]

        def pages() -> list[dict[str, Any]]:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=_ANSWER_S) as answer:
                return [one for one in json.load(answer) if one["type"] == "page" and one["url"] == self._url]

        assert until(pages, _START_S), "the browser does not open the page"
        return self._ending.enter_context(connect(pages()[0]["webSocketDebuggerUrl"], max_size=None, compression=None))

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._speech.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            said = json.loads(self._speech.recv(_ANSWER_S))
            if said.get("method") == "Runtime.exceptionThrown":
                self.errors.append(str(said["params"]["exceptionDetails"]))
            if said.get("id") == number:
                return dict(said.get("result", {}))

    def run(self, script: str) -> Any:
        """The value of an expression on the page; a promise is waited for."""
        told = self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in told, told["exceptionDetails"]
        return told["result"].get("value")

    def text(self, part: str) -> str:
        """What an element says, by its id."""
        return str(self.run(f"document.getElementById({json.dumps(part)}).textContent"))

    def click(self, part: str) -> None:
        """Press an element, by its id."""
        self.run(f"document.getElementById({json.dumps(part)}).click()")

    def press(self, code: str, key: str) -> None:
        """A key of the keyboard."""
        for kind in ("keyDown", "keyUp"):
            self._call("Input.dispatchKeyEvent", type=kind, code=code, key=key, text=key if kind == "keyDown" else "")

    def screenshot(self, file: Path) -> None:
        """What a person would see, as PNG."""
        file.write_bytes(base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"]))
