"""A headless Chromium, driven by the Chrome DevTools protocol over a pipe."""

from __future__ import annotations

import base64
import itertools
import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.programs import CHROMIUM

_ANSWER_S = 30.0


def wait_for(condition: Callable[[], Any], timeout_s: float = 30.0) -> Any:
    """Wait until a condition holds; returns its value."""
    deadline_s = time.monotonic() + timeout_s
    while not (value := condition()):
        if time.monotonic() > deadline_s:
            raise TimeoutError
        time.sleep(0.05)
    return value


class Browser:
    """A running Chromium. Messages are JSON, each ended by a zero byte (`--remote-debugging-pipe`)."""

    def __init__(self, process: subprocess.Popen[bytes], writing: int, reading: int) -> None:
        self.process = process
        self._writing, self._reading = writing, reading
        self._numbers, self._rest = itertools.count(1), b""

    def send(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol; returns its result."""
        number = next(self._numbers)
        message: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._writing, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                result: dict[str, Any] = answer["result"]
                return result

    def open(self, url: str) -> Tab:
        """Open a window: a page in a hidden tab has no stream."""
        target = self.send("Target.createTarget", url=url, newWindow=True)["targetId"]
        session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        return Tab(self, target, session)

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            data = os.read(self._reading, 1 << 20)
            assert data, "Chromium has ended"
            self._rest += data
        text, _, self._rest = self._rest.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        return message


class Tab:
    """One page."""

    def __init__(self, browser: Browser, target: str, session: str) -> None:
        self._browser, self._target, self._session = browser, target, session

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._browser.send(method, self._session, **parameters)

    def value(self, expression: str) -> Any:
        """Evaluate JavaScript; a promise is awaited."""
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, expression: str, timeout_s: float = 30.0) -> Any:
        """Wait until an expression is true; returns its value."""
        try:
            return wait_for(lambda: self.value(expression), timeout_s)
        except TimeoutError as error:
            text = self.value("document.body.innerText")
            raise TimeoutError(f"{expression} did not become true; the page: {text}") from error

    def click(self, x: float, y: float) -> None:
        self.drag(x, y, x, y)

    def drag(self, x: float, y: float, to_x: float, to_y: float) -> None:
        """Press the mouse at one point of the window, and release it at another; pixels."""
        mouse = {"button": "left", "buttons": 1, "clickCount": 1, "pointerType": "mouse"}
        self.send("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **mouse)
        for part in (0.5, 1.0):
            at = {"x": x + part * (to_x - x), "y": y + part * (to_y - y)}
            self.send("Input.dispatchMouseEvent", type="mouseMoved", **at, **mouse)
        self.send("Input.dispatchMouseEvent", type="mouseReleased", x=to_x, y=to_y, **mouse)

    def press(self, key: str, text: str = "") -> None:
        """Press and release a key."""
        code = {" ": 32, "Enter": 13, "Escape": 27, "Tab": 9, "ArrowDown": 40}.get(key, 0)
        common = {"key": key, "windowsVirtualKeyCode": code}
        down = {"type": "keyDown", "text": text} if text else {"type": "rawKeyDown"}
        self.send("Input.dispatchKeyEvent", **down, **common)
        self.send("Input.dispatchKeyEvent", type="keyUp", **common)

    def resize(self, width: int, height: int, *, dark: bool = False, touch: bool = False) -> None:
        """Set the window's size, the colour scheme and the kind of pointer."""
        scale = 2 if touch else 1
        size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": touch}
        self.send("Emulation.setDeviceMetricsOverride", **size)
        self.send("Emulation.setTouchEmulationEnabled", enabled=touch)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])

    def screenshot(self, path: Path, quality: int = 80) -> None:
        answer = self.send("Page.captureScreenshot", format="jpeg", quality=quality)
        path.write_bytes(base64.b64decode(answer["data"]))

    def close(self) -> None:
        self._browser.send("Target.closeTarget", targetId=self._target)


@contextmanager
def chromium(folder: Path) -> Iterator[Browser]:
    """Run Chromium with a new profile in a folder; ends all its processes afterwards."""
    assert CHROMIUM is not None
    to_browser, from_browser = os.pipe(), os.pipe()

    def place_pipes() -> None:
        # The protocol's descriptors are 3 and 4; those of the pipes may be the same numbers.
        reading, writing = os.dup(to_browser[0]), os.dup(from_browser[1])
        os.dup2(reading, 3)
        os.dup2(writing, 4)

    process = subprocess.Popen(
        [
            *(CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
            *("--remote-debugging-pipe", f"--user-data-dir={folder}", "--no-first-run"),
            *("--disable-background-networking", "--disable-extensions", "--mute-audio"),
            # Every process of its own costs half a second of a processor.
            *("--renderer-process-limit=1", "--in-process-gpu", "about:blank"),
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=place_pipes,
        pass_fds=(3, 4),
        start_new_session=True,
    )
    os.close(to_browser[0])
    os.close(from_browser[1])
    try:
        yield Browser(process, to_browser[1], from_browser[0])
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        os.close(to_browser[1])
        os.close(from_browser[0])
