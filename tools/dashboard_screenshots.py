"""The images of docs/how-to/dashboard.md: the page in Chromium, at a running `companion play`.

python -m tools.dashboard_screenshots docs/images

One vehicle seeks the car, a click on it opens the menu (dashboard.jpg), and *Follow* is pressed: the vehicle
follows (dashboard-dark.jpg, dashboard-phone.jpg). Then a fleet of four flies (dashboard-fleet.jpg).
In real time: three minutes of a computer that does nothing else, with `chromium` on the PATH.
"""

from __future__ import annotations

import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mavlink_sim.testing import free_port
from tests.alone.test_page import OPENED, REPLY, click_track, open_page
from tests.companion.dashboard.chromium import Tab, chromium
from tests.companion.simulation.test_play import playing

WIDE, PHONE = (1360, 860), (390, 844)
FLEET = 4
_FLIGHT_S = 90.0
# The charts show a minute.
_CHARTS_S = 20.0


def main() -> None:
    """Write the images to the folder that is named."""
    folder = Path(sys.argv[1])
    with _page() as tab:
        _one_vehicle(tab, folder)
    with _page("--vehicles", str(FLEET)) as tab:
        _fleet(tab, folder)


@contextmanager
def _page(*flags: str) -> Iterator[Tab]:
    listen = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    with tempfile.TemporaryDirectory() as name:
        for part in ("play", "profile"):
            Path(name, part).mkdir()
        with (
            playing(Path(name, "play"), "--dashboard-listen", listen, *flags) as service,
            chromium(Path(name, "profile")) as browser,
        ):
            service.wait_for_line(f"dashboard: http://{listen}/", 60.0)
            tab = open_page(browser, f"http://{listen}/")
            tab.resize(*WIDE)
            tab.until("state.topics.status && state.topics.vehicle && state.topics.vehicle.connected")
            yield tab


def _one_vehicle(tab: Tab, folder: Path) -> None:
    _command(tab, "takeoff 4")
    _command(tab, "seek car")
    click_track(tab)
    time.sleep(1.0)  # until the menu's box is drawn as the chosen one
    tab.screenshot(folder / "dashboard.jpg")
    tab.value("document.querySelector('#menu button').click()")
    _succeeded(tab, "follow", "accepted, in progress")
    time.sleep(_CHARTS_S)
    if not (behaviour := tab.value("state.topics.status.pilot.behaviour")).startswith("following"):
        raise SystemExit(f"the vehicle does not follow: {behaviour}")
    tab.resize(*WIDE, dark=True)
    time.sleep(1.0)
    tab.screenshot(folder / "dashboard-dark.jpg")
    tab.resize(*PHONE, touch=True)
    tab.send("Page.reload")  # the kind of pointer is read once
    tab.until(OPENED)
    tab.until("[...cameras.values()].some((camera) => camera.about?.boxes.length)")
    time.sleep(1.0)
    tab.screenshot(folder / "dashboard-phone.jpg", quality=70)


def _fleet(tab: Tab, folder: Path) -> None:
    tab.until(f"document.querySelectorAll('#fleet button').length === {FLEET}")
    for text in ("takeoff 5", "goto 8 0", "goto 12 4"):
        for number in reversed(range(FLEET)):  # those in front first, since they keep apart
            tab.value(f"document.querySelectorAll('#fleet button')[{number}].click()")
            tab.until("state.topics.vehicle && state.topics.vehicle.connected")
            _command(tab, text)
    time.sleep(1.0)
    tab.screenshot(folder / "dashboard-fleet.jpg")


def _command(tab: Tab, text: str) -> None:
    """Send a command by the page's field, and wait until it has succeeded."""
    tab.value(f"document.querySelector('#text').value = {text!r}")
    tab.value("document.querySelector('#sending button').click()")
    _succeeded(tab, text)


def _succeeded(tab: Tab, text: str, success: str = "done: ") -> None:
    reply = tab.until(f"{REPLY}.match(/{text}.*: ({success}|failed: ).*/)?.[0]", _FLIGHT_S)
    if ": failed: " in reply:
        raise SystemExit(reply)


if __name__ == "__main__":
    main()
