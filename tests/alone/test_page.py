"""The page in a real browser, at a running `companion play`."""

from __future__ import annotations

import itertools
import json
import math
import re
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest
import zenoh

from companion.bus.client import listen
from companion.bus.topics import COMMAND_STATE, DETECTIONS, EVENTS, IMAGE, ROOT, SETPOINT, STATUS, VEHICLE
from companion.guidance.grammar import json_schema
from mavlink_sim.testing import free_port
from tests.companion.dashboard.chromium import Browser, Tab, chromium, wait_for
from tests.companion.dashboard.serving import dashboard_command, dashboard_here
from tests.companion.dashboard.test_bridge import FOUND, NAME, Publisher, frame, publishing
from tests.companion.dashboard.test_dashboard_fleet import (
    OTHER,
    answering,
    publish_scene,
    state_at,
    two_vehicles,
)
from tests.companion.service_process import ServiceProcess
from tests.companion.simulation.test_play import playing
from tests.programs import AXE

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240), pytest.mark.needs("chromium")]

SCENE = """
[ground]
kinds = ["meadow"]
tile_texels = 512
texel_m = 0.08
[[objects]]
class = "car"
appearance = 4
place_m = [14.0, 0.5]
yaw_deg = 90
[camera]
width = 320
height = 240
horizontal_fov_deg = 70
rate_hz = 3
[camera.mount]
pitch_deg = -20
"""
BOXES = "[...cameras.values()].flatMap((camera) => camera.about ? camera.about.boxes : [])"
REPLY = "document.querySelector('#reply').textContent"
LINK = "(document.querySelector('#link')?.textContent ?? '')"

OPENED = """
location.protocol === 'http:' && document.readyState === 'complete'
  && Promise.all(['state', 'stream', 'cameras'].map((name) => import(`/${name}.js`)))
    .then((modules) => Object.assign(globalThis, ...modules) && true)
"""


def open_page(browser: Browser, url: str) -> Tab:
    """Open the page in a window; what its modules export becomes global, for the expressions below."""
    tab = browser.open(url)
    tab.until(OPENED)
    return tab


@contextmanager
def page_at(window: Tab, url: str) -> Iterator[Tab]:
    """Load the page in an open window: a new window costs a process. The window is empty afterwards."""
    window.resize(1280, 900)
    window.send("Page.navigate", url=url)
    window.until(OPENED)
    try:
        yield window
    finally:
        window.value("location.protocol === 'http:' && sessionStorage.clear()")
        window.send("Emulation.setFocusEmulationEnabled", enabled=False)
        window.send("Page.navigate", url="about:blank")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as running:
        yield running


@pytest.fixture(scope="module")
def window(browser: Browser) -> Tab:
    return browser.open("about:blank")


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    listen = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    folder = tmp_path_factory.mktemp("play")
    (folder / "car.toml").write_text(SCENE)
    flags = ("--scene", "car.toml", "--dashboard-listen", listen, "--detector-image-size", "320")
    with playing(folder, *flags) as running:
        running.wait_for_line(f"dashboard: http://{listen}/", 60.0)
        running.url = f"http://{listen}/"
        yield running


@pytest.fixture
def tab(window: Tab, service: ServiceProcess) -> Iterator[Tab]:
    with page_at(window, service.url) as page:
        yield page


def rectangle(tab: Tab, selector: str) -> tuple[float, float, float, float]:
    """Left, top, width and height of an element in the window, pixels."""
    box = tab.value(f"document.querySelector('{selector}').getBoundingClientRect().toJSON()")
    return box["left"], box["top"], box["width"], box["height"]


def click_track(tab: Tab) -> int:
    """Click the largest box of a confirmed car and wait for its menu; returns the track's id.

    As a person does, again if it has moved in the image that was clicked.
    """
    for _ in range(4):
        boxes = tab.until(f"{BOXES}.filter((box) => box[4] === 'car' && box[7] === 'confirmed')", 60.0)
        largest = max(boxes, key=lambda box: (box[2] - box[0]) * (box[3] - box[1]))
        tab.click(*point_of(tab, largest))
        if not tab.value("document.querySelector('#menu').hidden"):
            return int(largest[6])
    raise AssertionError(tab.value("document.body.innerText"))


def point_of(tab: Tab, box: list[Any]) -> tuple[float, float]:
    """In the lower right part of a box: the menu opens from there, and does not cover it."""
    x, y, width, height = rectangle(tab, "figure canvas")
    left, top, right, bottom = box[:4]
    return x + (0.2 * left + 0.8 * right) * width, y + (0.2 * top + 0.8 * bottom) * height


def test_click_means_a_box_of_the_image_that_was_pressed(tab: Tab) -> None:
    boxes = tab.until(f"{BOXES}.filter((box) => box[4] === 'car' && box[7] === 'confirmed')", 60.0)
    x, y = point_of(tab, boxes[0])
    event = f"{{button: 0, pointerType: 'mouse', clientX: {x}, clientY: {y}, pointerId: 1}}"
    # Between the two events, in one turn, a newer image without boxes comes.
    tab.value(f"""
        const camera = [...cameras.values()].find((one) => one.about?.boxes.length);
        camera.canvas.setPointerCapture = () => null;
        camera.about = {{...camera.about, boxes: {json.dumps(boxes[:1])}}};
        camera.press({event});
        camera.about = {{...camera.about, boxes: []}};
        camera.release({event});
    """)
    assert not tab.value("document.querySelector('#menu').hidden")
    assert tab.value("document.querySelector('#menu').textContent").startswith(f"track {boxes[0][6]}, ")


def test_rectangle_selects_what_is_in_it(tab: Tab) -> None:
    tab.until("[...cameras.values()].some((camera) => camera.bitmap !== null)")
    left, top, width, height = rectangle(tab, "figure canvas")
    tab.drag(left + 0.4 * width, top + 0.3 * height, left + 0.5 * width, top + 0.5 * height)
    tab.until(f"{REPLY}.startsWith('select ')")
    words = tab.value(REPLY).partition(": ")[0].split()[1:]
    sent = {key: float(value) for key, _, value in (word.partition("=") for word in words)}
    assert sent == pytest.approx({"x": 0.4, "y": 0.3, "width": 0.1, "height": 0.2}, abs=0.01)


def on_the_ground(service: ServiceProcess, tab: Tab) -> None:
    tab.until("state.topics.vehicle && state.topics.status")
    if tab.value("state.topics.vehicle.armed"):
        assert service.command("land")["success"]
        tab.until("!state.topics.vehicle.armed", 60.0)


def in_the_air(service: ServiceProcess, tab: Tab) -> None:
    tab.until("state.topics.vehicle && state.topics.status")
    if not tab.value("state.topics.vehicle.armed"):
        service.take_off(3.0)


def test_takeoff_button_and_space_bar(service: ServiceProcess, tab: Tab) -> None:
    on_the_ground(service, tab)
    assert "car" in tab.value("[...document.querySelector('#class').options].map((option) => option.value)")
    tab.value("document.querySelector('#altitude').value = 3")
    tab.value("document.querySelector('[data-command^=takeoff]').click()")
    tab.until(f"{REPLY}.startsWith('takeoff 3: done')", 60.0)
    tab.until("document.querySelector('#armed').textContent === 'yes'")
    assert tab.value("Number.parseFloat(document.querySelector('#height').textContent)") > 2.0
    tab.until("document.querySelector('#log').textContent.includes('command: takeoff altitude=3')")
    # Space stops although a button has the focus, and does not press that button.
    tab.value("document.querySelector('[data-command=land]').focus()")
    tab.press(" ", " ")
    tab.until(f"{REPLY}.startsWith('stop: ')")
    # In the field of commands it is a character.
    tab.value("document.querySelector('#text').focus()")
    for key in "hold 1":
        tab.press(key, key)
    assert tab.value("document.querySelector('#text').value") == "hold 1"
    tab.press("Enter", "\r")
    tab.until(f"{REPLY}.startsWith('hold 1: ')")


def test_clicked_car_is_followed(service: ServiceProcess, tab: Tab) -> None:
    in_the_air(service, tab)
    number = click_track(tab)
    title, *items = tab.value("[...document.querySelector('#menu').children].map((item) => item.textContent)")
    assert title.startswith(f"track {number}, ")
    assert items == ["Follow", "Approach", "Orbit"]  # and it has no gimbal
    tab.value("document.querySelector('#menu button').click()")
    assert tab.value("document.querySelector('#menu').hidden")
    tab.until(f"{REPLY} === 'follow track={number}: accepted, in progress'")
    # From 14 m to the 8 m that it keeps. If the car gets another id meanwhile, the status has both.
    called = f"(?:{number}|([0-9]+) [(]was {number}[)])"
    said = f"state.topics.status.pilot.behaviour.match(/^following track {called}, ([0-9.]+) m/)"
    tab.until(f"Math.abs({said}?.[2] - 8) < 0.5", 60.0)
    tab.until(f"{BOXES}.some((box) => box[4] === 'car' && box[6] === Number({said}?.[1] ?? {number}))")


STEERING = "document.querySelector('#steer').getAttribute('aria-pressed') === 'true'"
PAD = "navigator.getGamepads = () => [null, {mapping: 'standard', axes: [0, 0, 0, AXIS]}]"


def hold_key(tab: Tab, kind: str) -> None:
    tab.send("Input.dispatchKeyEvent", type=kind, key="w", code="KeyW", windowsVirtualKeyCode=87)


def test_keys_and_gamepad_steer_and_a_lost_page_brakes(service: ServiceProcess, tab: Tab) -> None:
    in_the_air(service, tab)
    received: dict[str, Any] = {}

    def faster(than_mps: float) -> bool:
        return "vehicle" in received and math.hypot(*received["vehicle"]["velocity_ned_mps"][:2]) > than_mps

    with service.client() as session:
        for name in ("vehicle", "status"):
            listen(
                session, name, lambda key, text: received.update({key.rpartition("/")[2]: json.loads(text)})
            )
        tab.send("Emulation.setFocusEmulationEnabled", enabled=True)
        tab.value("document.querySelector('#steer').click()")
        tab.until(STEERING)
        assert tab.value(REPLY).startswith("velocity source=page-")
        hold_key(tab, "rawKeyDown")
        wait_for(lambda: faster(0.6))
        hold_key(tab, "keyUp")
        tab.value(PAD.replace("AXIS", "1"))
        wait_for(lambda: faster(0.6))
        tab.value(PAD.replace("AXIS", "0.1"))  # in the dead zone
        wait_for(lambda: not faster(0.25))
        tab.value(PAD.replace("AXIS", "1"))
        wait_for(lambda: faster(0.6))
        tab.send("Page.navigate", url="about:blank")
        wait_for(lambda: not faster(0.25))
        wait_for(lambda: re.match("velocity of page-.*, silent", received["status"]["pilot"]["behaviour"]))


def test_second_window_cannot_steer_and_another_command_ends_it(
    browser: Browser, service: ServiceProcess, tab: Tab
) -> None:
    other = open_page(browser, service.url)
    in_the_air(service, tab)
    tab.value("document.querySelector('#steer').click()")
    tab.until(STEERING)
    other.until("/^velocity of page-[a-z0-9]+$/.test(state.topics.status?.pilot.behaviour)")
    other.value("document.querySelector('#steer').click()")
    other.until(f"/^velocity source=page-.*: failed: velocity: page-.* steers/.test({REPLY})")
    assert not other.value(STEERING)
    assert tab.value(STEERING)
    other.close()
    tab.press(" ", " ")
    tab.until(f"{REPLY}.startsWith('stop: done')")
    tab.until(f"!({STEERING})")


def test_page_shows_a_stop_button_and_names_on_a_phone(window: Tab) -> None:
    healthy = {**NOT_HEALTHY, "healthy": True, "unhealthy": []}
    jpeg = cv2.imencode(".jpg", np.zeros((480, 640, 3), np.uint8))[1].tobytes()
    with publishing() as (service, endpoint), dashboard_here(endpoint) as url, page_at(window, url) as tab:
        sequence = itertools.count(1)

        def shown() -> bool:
            number = next(sequence)
            for key, body in ((STATUS, healthy), (VEHICLE, SEEN), (DETECTIONS, frame(number))):
                service.publish(key.key(NAME), body)
            service.image(number, jpeg)
            caption = "(document.querySelector('figcaption')?.textContent ?? '').includes('7.0 results/s')"
            return bool(tab.value(f"{LINK} === 'PX4 · healthy' && {caption} && {BOXES}.length"))

        tab.resize(390, 844, touch=True)
        left, top, width, height = rectangle(tab, "#stop")
        assert left >= 0
        assert top > 700
        assert left + width <= 390
        assert top + height <= 844
        assert tab.value("document.documentElement.scrollWidth") <= 390
        steer, turn = rectangle(tab, "#steer"), rectangle(tab, "#steer-turn")
        wait_for(shown)
        # What arrives does not move the buttons.
        assert rectangle(tab, "#steer") == pytest.approx(steer, abs=1.0)
        assert steer[1] < turn[1] + turn[3] / 2 < steer[1] + steer[3]  # in one row
        named = "control.ariaLabel || control.textContent.trim() || (control.labels && control.labels.length)"
        controls = "[...document.querySelectorAll('button, input, select, canvas')]"
        assert (
            tab.value(f"{controls}.filter((control) => !({named})).map((control) => control.outerHTML)") == []
        )


def test_stop_works_with_the_page_in_many_windows(browser: Browser, service: ServiceProcess) -> None:
    tabs = [open_page(browser, service.url) for _ in range(7)]  # one more than its connections
    try:
        for opened in tabs:
            opened.until("state.at > 0 || state.replaced")
        newest = tabs[-1]
        newest.until("state.topics.status")
        newest.value("document.querySelector('#stop').click()")
        newest.until(f"/^stop: (done|failed)/.test({REPLY})", 5.0)
    finally:
        for opened in tabs:
            opened.close()


def test_page_says_when_the_dashboard_is_gone(window: Tab) -> None:
    with publishing() as (service, endpoint), ExitStack() as running:
        url = running.enter_context(dashboard_here(endpoint))
        with page_at(window, url) as tab:

            def shown() -> bool:
                service.publish(STATUS.key(NAME), NOT_HEALTHY)
                return bool(tab.value("state.topics.status"))

            wait_for(shown)
            running.close()
            tab.until(f"/does not answer; everything here is [0-9]+ s old/.test({LINK})")


REQUESTS = "performance.getEntriesByType('resource').map((entry) => entry.toJSON())"


def images(tab: Tab) -> list[dict[str, Any]]:
    """The requests of images that have ended, with `camera`, `startTime` and `responseEnd` in ms."""
    found = [(urlsplit(entry["name"]), entry) for entry in tab.value(REQUESTS)]
    return [
        {**entry, "camera": parse_qs(url.query, keep_blank_values=True)["camera"][0]}
        for url, entry in found
        if url.path == "/image"
    ]


def most_at_once(requests: list[dict[str, Any]]) -> int:
    spans: list[tuple[float, float]] = [(one["startTime"], one["responseEnd"]) for one in requests]
    return max(sum(begun <= at < ended for begun, ended in spans) for at, _ in spans)


def test_cameras_take_turns_and_stop_has_a_free_connection(browser: Browser, window: Tab) -> None:
    names = ["", "down", "left", "right"]
    jpeg = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    with publishing() as (service, endpoint), dashboard_command(endpoint) as url, page_at(window, url) as tab:
        answering({NAME: service})
        sequence = itertools.count()

        def publish(seconds: float, *cameras: str) -> None:
            for end_s in np.arange(time.monotonic() + 0.05, time.monotonic() + seconds, 0.05):
                about = {"sequence": next(sequence), "captured_ns": time.monotonic_ns()}
                for name in cameras:
                    service.publish(DETECTIONS.key(NAME, name or None), frame(about["sequence"]))
                    key = IMAGE.key(NAME, name or None)
                    service.session.put(key, jpeg, attachment=json.dumps(about))
                time.sleep(max(0.0, end_s - time.monotonic()))

        def begin() -> None:
            tab.value("performance.clearResourceTimings(); performance.setResourceTimingBufferSize(9999)")

        def answered() -> Counter[str]:
            return Counter(one["camera"] for one in images(tab) if one["responseStatus"] == 200)

        def shown() -> bool:
            publish(0.2, *names)
            return bool(tab.value("[...cameras.values()].filter((view) => view.bitmap).length === 4"))

        wait_for(shown)
        begin()
        publish(2.5, *names)
        assert most_at_once(images(tab)) == 2
        counts = answered()
        assert set(counts) == set(names)
        assert min(counts.values()) > 0.5 * max(counts.values())
        # Cameras without images take no turns of the others.
        publish(1.0, "right")
        begin()
        publish(2.5, "right")
        assert most_at_once(images(tab)) == 2
        assert answered()["right"] > 0.5 * max(counts.values())
        # A second window takes its part of the connections.
        other = open_page(browser, url)
        other.until("state.maxImages === 1 && cameras.size === 4")
        tab.until("state.maxImages === 1")
        publish(1.0, *names)
        begin()
        publish(1.0, "right")
        other.value("document.querySelector('#stop').click()")
        other.until(f"{REPLY} === 'stop: done: holding'")
        assert most_at_once(images(tab)) == 1
        (stop,) = [one for one in other.value(REQUESTS) if one["name"].endswith("/command")]
        assert stop["requestStart"] - stop["startTime"] < 200.0  # an image may be waited for for 500
        other.close()


def test_page_shows_a_silent_service_and_the_age_of_its_state(window: Tab) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    with dashboard_here(endpoint) as url, page_at(window, url) as tab:
        tab.until(f"{LINK}.includes('no zenoh node at ')")
        with publishing(endpoint) as (service, _):

            def shown() -> bool:
                service.publish(VEHICLE.key("vehicle1"), {"mode": "hold", "connected": True})
                return bool(tab.value("document.querySelector('#mode').textContent === 'hold'"))

            wait_for(shown)
        tab.until(f"/Shown is its state of [0-9]+ s ago/.test({LINK})")
        said = tab.value("[...document.querySelectorAll('#outage p')].map((line) => line.innerText)")
        assert "remote control" in said[2]
        assert all(said)
        buttons = "[...document.querySelectorAll('#commands button')]"
        assert set(tab.value(f"{buttons}.map((item) => item.disabled && item.title !== '')")) == {True}
        assert not tab.value("document.querySelector('#stop').disabled")
        assert tab.value("document.querySelector('#off').innerText")
        with publishing(endpoint) as (service, _):
            wait_for(shown)
            tab.until("document.querySelector('#outage').hidden")
            assert not tab.value("document.querySelector('[data-command=land]').disabled")


def test_page_says_how_an_endless_command_has_ended(window: Tab) -> None:
    with publishing() as (service, endpoint), dashboard_here(endpoint) as url, page_at(window, url) as tab:
        answering({NAME: service}, id="s-1", state="in_progress", reason="in progress")
        tab.until("state.at > 0 && state.alive")
        tab.value("document.querySelector('[data-command=hold]').click()")
        tab.until(f"{REPLY} === 'hold: accepted, in progress'")
        kind = "document.querySelector('#reply').className"
        assert tab.value(kind) == "good"
        reason = "the pilot took over: position mode"
        ended = {"id": "s-1", "state": "ended", "success": False, "reason": reason}
        service.publish(COMMAND_STATE.key(NAME), {**ended, "id": "s-2"})
        service.publish(COMMAND_STATE.key(NAME), ended)
        tab.until(f"{REPLY} === 'hold: ended: {reason}'")
        assert tab.value(kind) == "ended"


# Pixels of the fence's colour in the map.
FENCE = """
(() => {
  const map = document.querySelector('#map');
  const { data } = map.getContext('2d').getImageData(0, 0, map.width, map.height);
  const is = (i) => data[i] === 0x0d && data[i + 1] === 0x7a && data[i + 2] === 0x3e;
  return data.filter((_, i) => i % 4 === 0 && is(i)).length;
})()
"""
MISSION = {
    "name": "demo",
    "steps": ["takeoff altitude=4", "find", "home"],
    "current": 1,
    "ended": [{"title": "takeoff altitude=4", "success": True, "reason": "took off"}],
}


def test_page_shows_the_state_and_the_menu_of_a_track(window: Tab) -> None:
    limits = {"fence_include": [[-20, -20], [-20, 20], [20, 20], [20, -20]], "fence_exclude": []}
    vehicle = {
        "mode": "offboard",
        "armed": True,
        "altitude_m": 4.0,
        "battery_fraction": 0.731,
        "attitude_wxyz": [0.9659, 0.2588, 0.0, 0.0],
        "yaw_rad": 1.5708,
        "velocity_ned_mps": [1.0, 0.0, 0.0],
        "position_ned_m": [3.0, 4.0, -4.0],
    }
    # Of the same object, and smaller.
    unsure = {**FOUND, "class_name": "truck", "xyxy": [70.0, 60.0, 310.0, 230.0], "track_id": 8}
    unsure.update(track_state="tentative", depth_m=5.4)
    found = {**FOUND, "ground_range_m": 4.2, "distance_m": 6.0, "depth_m": 5.4}
    jpeg = cv2.imencode(".jpg", np.zeros((480, 640, 3), np.uint8))[1].tobytes()
    asked, sent = {"velocity_ned_mps": [2.0, 0.0, 0.0]}, {"velocity_ned_mps": [1.5, 0.0, 0.0]}
    camera = {"name": "camera", "state": "failed", "reason": "no camera 9", "next_try_ns": 8_000_000_000}
    autopilot = {"name": "autopilot", "state": "ready", "reason": "", "next_try_ns": None}
    status = {"healthy": True, "vehicle": {}, "limits": limits, "pilot": {"mission": MISSION}, "gimbal": None}
    status |= {"parts": [autopilot, camera], "stamp_ns": 1_000_000_000}
    messages = {
        STATUS.key(NAME): status,
        VEHICLE.key(NAME): vehicle,
        SETPOINT.key(NAME): {"asked": asked, "sent": sent, "limited_by": ["speed"]},
        DETECTIONS.key(NAME): frame(
            1, captured_ns=10_000_000, published_ns=35_000_000, detections=[found, unsure]
        ),
        EVENTS.key(NAME): {"stamp_ns": 1, "level": "error", "text": "battery 7"},
    }
    with publishing() as (service, endpoint), dashboard_here(endpoint) as url, page_at(window, url) as tab:

        def shown() -> bool:
            for key, body in messages.items():
                service.publish(key, body)
            service.image(1, jpeg)
            return bool(tab.value("state.topics.status && document.querySelector('#log li') !== null"))

        def text(selector: str) -> list[str]:
            found = f"[...document.querySelectorAll('{selector}')]"
            texts: list[str] = tab.value(f"{found}.map((item) => item.ariaLabel ?? item.textContent)")
            return texts

        def becomes(selector: str, expected: list[str]) -> None:
            # Each topic arrives by itself, and a busy page leaves messages out.
            with suppress(TimeoutError):
                wait_for(lambda: shown() and text(selector)[-len(expected) :] == expected)
            assert text(selector)[-len(expected) :] == expected

        wait_for(shown)
        becomes("#link", ["Waiting for camera: no camera 9, next try in 7 s"])
        status["parts"] = []
        becomes("#link", ["no vehicle · healthy"])
        becomes("#mode, #armed, #height, #speed, #battery", ["offboard", "yes", "4.0 m", "1.0 m/s", "73 %"])
        # Over ground, never along the camera's axis.
        becomes("#detections td:nth-child(4)", ["4.2 m", "–"])
        becomes("#attitude", ["Roll 30°, pitch 0°, heading 90°"])
        becomes("#setpoint tr:first-child td", ["1.00", "2.00", "1.50"])
        becomes("#limited", ["Limited by: speed"])
        becomes("#latency", ["Latency of the last minute: capture to result 25 ms"])
        becomes("#steps .good, #steps .now", ["takeoff altitude=4", "find"])
        assert text("#log .error")[0].endswith("error: battery 7")
        assert text("#map")[0].startswith("Map, north")
        assert ": vehicle 3 m north and 4 m east " in text("#map")[0]
        assert tab.value(FENCE) > 100
        ground = "getComputedStyle(document.documentElement).backgroundColor"
        light = tab.value(ground)
        tab.resize(1280, 900, dark=True)
        assert tab.value(ground) != light
        wait_for(lambda: shown() and tab.value(f"{BOXES}.length === 2"))
        assert click_track(tab) == 7
        assert text("#menu p") == ["track 7, car"]
        tab.value("document.querySelector('#detections button').focus()")
        tab.press("Enter", "\r")
        focus = "document.activeElement.textContent"
        tab.until(f"{focus} === 'Follow'")
        tab.press("ArrowDown")
        assert tab.value(focus) == "Approach"
        tab.press("Escape")
        assert tab.value("document.querySelector('#menu').hidden")
        assert tab.value(focus) == "#7"
        assert text("#menu button") == ["Follow", "Approach", "Orbit"]
        messages[STATUS.key(NAME)] = {**status, "gimbal": {"answers": True}}
        wait_for(lambda: shown() and tab.value("state.topics.status.gimbal !== null"))
        tab.press("Enter", "\r")
        assert text("#menu button") == ["Follow", "Approach", "Orbit", "Point gimbal"]


SEEN = {
    "mode": "offboard", "armed": True, "altitude_m": 4.0, "battery_fraction": 0.7, "yaw_rad": 1.6,
    "attitude_wxyz": [0.9659, 0.2588, 0.0, 0.0], "velocity_ned_mps": [1.0, 0.0, 0.0],
    "position_ned_m": [3.0, 4.0, -4.0],
}  # fmt: skip
NOT_HEALTHY = {
    "service": "s", "stamp_ns": 1, "healthy": False,
    "unhealthy": ["camera: no result for 3.1 s", "PREFLIGHT_FAIL_" * 6],
    "vehicle": {"autopilot": "PX4", "without_service": "without setpoints PX4 holds its position"},
    "parts": [{"name": "autopilot", "state": "ready", "reason": "", "next_try_ns": None}],
    "pilot": {"mission": MISSION, "behaviour": "holding"}, "limits": {}, "gimbal": None,
    "perception": {"state": "running", "class_names": ["person", "car"], "rate_hz": 7.0, "problem": ""},
}  # fmt: skip
LOOKS: dict[str, dict[str, Any]] = {
    "light": {"width": 1280, "height": 900},
    "dark": {"width": 1280, "height": 900, "dark": True},
    "phone": {"width": 390, "height": 844, "touch": True},
    "dark phone": {"width": 390, "height": 844, "touch": True, "dark": True},
    "phone across": {"width": 844, "height": 390, "touch": True},
    "tablet": {"width": 768, "height": 1024, "touch": True},
    "dark tablet": {"width": 768, "height": 1024, "touch": True, "dark": True},
    "tablet across": {"width": 1024, "height": 768, "touch": True},
    "dark tablet across": {"width": 1024, "height": 768, "touch": True, "dark": True},
}
LOOKS_OF = {
    "mouse": [look for look, size in LOOKS.items() if not size.get("touch")],
    "touch": [look for look, size in LOOKS.items() if size.get("touch")],
}


@contextmanager
def populated(window: Tab, pointer: str) -> Iterator[tuple[Tab, Callable[[], bool], Callable[[], None]]]:
    """The page with something in every part; yielded with it: what shows that again, and ends the service.

    It is of the first of `LOOKS` with that pointer.
    """
    jpeg = cv2.imencode(".jpg", np.full((480, 640, 3), 90, np.uint8))[1].tobytes()
    messages = {
        STATUS.key(NAME): NOT_HEALTHY,
        VEHICLE.key(NAME): SEEN,
        SETPOINT.key(NAME): {"asked": SEEN, "sent": SEEN, "limited_by": ["speed"]},
        DETECTIONS.key(NAME): frame(1, captured_ns=1, published_ns=35_000_000),
        EVENTS.key(NAME): {"stamp_ns": 1, "level": "warning", "text": "battery 7"},
    }
    with ExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        url = stack.enter_context(dashboard_here(endpoint))
        running = stack.enter_context(ExitStack())
        service, _ = running.enter_context(publishing(endpoint))
        tab = stack.enter_context(page_at(window, url))
        tab.resize(**LOOKS[LOOKS_OF[pointer][0]])
        tab.send("Page.reload")  # the kind of pointer is read once
        tab.until(OPENED)

        def shown() -> bool:
            for key, body in messages.items():
                service.publish(key, body)
            service.image(1, jpeg)
            parts = "#log li, #detections td button, #steps li, figcaption, #class option"
            everything = f"'{parts}'.split(', ').every((part) => document.querySelector(part))"
            return bool(tab.value(f"state.topics.status && {everything}"))

        answering({NAME: service}, id="s-1", state="in_progress", reason="in progress")
        wait_for(shown)
        tab.value("document.querySelector('[data-command=hold]').click()")
        tab.until(f"{REPLY} === 'hold: accepted, in progress'")
        tab.until("/not healthy: camera: no result/.test(document.querySelector('#link').textContent)")
        yield tab, shown, running.close


def open_menu(tab: Tab, shown: Callable[[], bool]) -> None:
    """Open the menu of the track in the list. Detections leave it within seconds."""
    press = "[document.querySelector('#detections button')].filter(Boolean).map((item) => item.click())"
    wait_for(lambda: shown() and tab.value(f"{press}.length"))


def violations(tab: Tab, look: str) -> list[str]:
    """What axe finds against WCAG 2.2, A and AA; of a dark look only its colours: the rest is as in light."""
    rules = "['color-contrast', 'link-in-text-block']"
    if not LOOKS[look].get("dark"):
        rules = "['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'wcag22aa']"
    options = f"{{runOnly: {rules}, resultTypes: ['violations']}}"
    found = tab.value(f"axe.run(document, {options})")["violations"]
    return [f"{one['id']}: {node['html'][:200]}" for one in found for node in one["nodes"]]


@pytest.mark.needs("axe-core")
@pytest.mark.parametrize("pointer", LOOKS_OF)
def test_page_is_accessible(window: Tab, pointer: str) -> None:
    with populated(window, pointer) as (tab, shown, end_service):
        tab.value(f"{AXE.read_text()}; 0")

        def found() -> dict[str, list[str]]:
            """By look; without those that have none."""
            by_look = {}
            for look in LOOKS_OF[pointer]:
                tab.resize(**LOOKS[look])
                by_look[look] = violations(tab, look)
            return {look: wrong for look, wrong in by_look.items() if wrong}

        wait_for(shown)
        assert found() == {}
        for look in LOOKS_OF[pointer]:
            tab.resize(**LOOKS[look])
            open_menu(tab, shown)
            assert violations(tab, look) == [], look
            tab.press("Escape")
        end_service()
        tab.until("!document.querySelector('#outage').hidden")
        assert found() == {}


TOUCHED = [look for look in LOOKS_OF["touch"] if not LOOKS[look].get("dark")]
# What is shown of an element of the header and of the rows below it: left, top, right and bottom.
EDGES = """
['#stops', '#vehicle', '#summary', '#link', 'header', 'main', '#sticks'].map((name) => {
  const one = document.querySelector(name);
  const { left, top, right, bottom } = one.getBoundingClientRect();
  return one.hidden ? null : [left, top, right, bottom];
})
"""


def apart(one: list[float], other: list[float]) -> bool:
    """Whether two rectangles share no more than a rounded edge."""
    return any(one[axis + 2] <= other[axis] + 0.5 or other[axis + 2] <= one[axis] + 0.5 for axis in (0, 1))


def test_touch_has_large_targets_and_a_stop_that_covers_nothing(window: Tab) -> None:
    with populated(window, "touch") as (tab, shown, _):
        for look in TOUCHED:
            tab.resize(**LOOKS[look])
            check_touch(tab, shown, look)


def check_touch(tab: Tab, shown: Callable[[], bool], look: str) -> None:
    width, height = LOOKS[look]["width"], LOOKS[look]["height"]
    open_menu(tab, shown)
    targets = "[...document.querySelectorAll('button, input, select')].filter((one) => one.offsetParent)"
    small = "({width, height}) => width < 44 || height < 44"
    boxes = f"{targets}.map((one) => [one.outerHTML, one.getBoundingClientRect()])"
    assert tab.value(f"{boxes}.filter(([, box]) => ({small})(box)).map(([html]) => html)") == []
    menu = rectangle(tab, "#menu")
    stop, *_ = tab.value(EDGES)
    assert apart(stop, [menu[0], menu[1], menu[0] + menu[2], menu[1] + menu[3]])
    tab.press("Escape")
    assert "W A S D" not in tab.value("document.body.innerText")
    assert "space bar" not in tab.value("document.body.innerText").lower()
    cut = "({scrollWidth, clientWidth}) => scrollWidth > clientWidth + 1"
    parts = f"[...document.querySelectorAll('header > *, section')].filter({cut})"
    assert tab.value("document.documentElement.scrollWidth") <= width
    assert tab.value(f"{parts}.map((one) => one.id)") == []
    scrolled = "(document.querySelector('main').scrollTo(0, {0}), scrollTo(0, {0}))"
    for sticks in ("true", "false"):
        tab.value(f"document.querySelector('#sticks').hidden = {sticks}")
        for scroll in (0, 10_000):
            tab.value(scrolled.format(scroll))
            stop, *words, header, main, pads = tab.value(EDGES)
            assert all(apart(stop, one) for one in words)
            assert pads is None or apart(stop, pads)
            # What scrolls is under the opaque header, or ends above STOP.
            assert apart(stop, main) or (header[1] <= stop[1] and stop[3] <= header[3])
            middle = f"({(stop[0] + stop[2]) / 2}, {(stop[1] + stop[3]) / 2})"
            assert tab.value(f"document.elementFromPoint{middle}.id") == "stop"
    tab.value(scrolled.format(0))
    if look.startswith(("tablet", "phone across")):
        assert sum(rectangle(tab, "[data-command=hold]")[1::2]) <= height


def test_sticks_steer_by_touch_and_go_with_the_service(window: Tab) -> None:
    with populated(window, "touch") as (tab, _, end_service):
        tab.value("document.querySelector('#steer').click()")
        tab.until(STEERING)
        assert tab.value("!document.querySelector('#sticks').hidden")
        left, top, width, _ = rectangle(tab, "[data-y=forward]")
        press = f"{{bubbles: true, pointerId: 1, clientX: {left + width / 2}, clientY: {top + 1}}}"
        # A synthetic event has no pointer that could be captured.
        tab.value("""
            globalThis.sent = [];
            const native = globalThis.fetch;
            globalThis.fetch = (url, more) => {
              if (url === '/velocity') sent.push(JSON.parse(more.body));
              return native(url, more);
            };
            for (const pad of document.querySelectorAll('.stick')) {
              pad.setPointerCapture = () => null;
              pad.hasPointerCapture = () => true;
            }
        """)
        pad = "document.querySelector('[data-y=forward]')"
        tab.value(f"{pad}.dispatchEvent(new PointerEvent('pointerdown', {press}))")
        tab.until("sent.some((one) => one.forward_mps > 0.9 && Math.abs(one.right_mps) < 0.1)")
        tab.value(f"{pad}.dispatchEvent(new PointerEvent('pointerup', {press})); sent.length = 0")
        tab.until("sent.some((one) => one.forward_mps === 0)")
        end_service()
        tab.until("document.querySelector('#sticks').hidden")


def test_page_of_a_fleet_switches_the_vehicle_and_stops_all(window: Tab) -> None:
    with two_vehicles() as (services, endpoint), dashboard_here(endpoint) as url, page_at(window, url) as tab:
        received = answering(services)

        def until(expression: str) -> None:
            def shown() -> bool:
                publish_scene(services)
                return bool(tab.value(expression))

            wait_for(shown)

        text = "document.querySelector('{}').{}".format
        listed = "[...document.querySelectorAll('#fleet button')].map((item) => item.value).join()"
        until(f"{listed} === 'vehicle1,vehicle2'")
        # One car, seen by both, and the person that only the other one sees.
        until(f"{text('#map', 'ariaLabel')}.includes('car vehicle1 #7, vehicle2 #3')")
        until(f"{text('#map', 'ariaLabel')}.includes('person vehicle2 #4')")
        # The other one's trail, of points that are 0.3 m apart.
        points = "[...state.trails].map(([name, trail]) => [name, trail.length])"
        assert tab.value(points) == [[NAME, 1], [OTHER, 1]]
        latest = "state.trails.get('vehicle2').at(-1)[1]"
        for east_m in (1.2, 2.0):
            services[OTHER].publish(VEHICLE.key(OTHER), state_at(OTHER, 2.0, east_m))
            tab.until(f"Math.abs(state.vehicles[1].at_ned_m[1] - {5.0 + east_m}) < 0.1")
        tab.until(f"Math.abs({latest} - 2) < 0.1")  # in its own local NED
        assert tab.value(points) == [[NAME, 1], [OTHER, 2]]
        hidden = "new MutationObserver(() => { wasHidden ||= document.querySelector('#stop-all').hidden })"
        observe = "observe(document.body, {subtree: true, attributes: true})"
        tab.value(f"globalThis.wasHidden = false; {hidden}.{observe}")
        tab.value("document.querySelectorAll('#fleet button')[1].click()")
        until(f"{text('#vehicle', 'textContent')} === 'vehicle2' && location.search === '?vehicle=vehicle2'")
        until("state.at > 0 && state.vehicles.length === 2")  # of the new stream
        assert tab.value("wasHidden") is False  # STOP ALL
        assert tab.value(f"{points}.map(([name, length]) => [name, length > 1])") == [
            [NAME, False],
            [OTHER, True],
        ]
        until(f"{text('#map', 'ariaLabel')}.includes('car vehicle1 #7, vehicle2 #3')")
        until(f"{text('#map', 'ariaLabel')}.includes('vehicle 2 m north and 1 m east of home')")
        tab.value("document.querySelector('[data-command=land]').click()")
        tab.until(f"{REPLY} === 'vehicle2: land: done: holding'")
        assert received == [("vehicle2", "land")]
        tab.press(" ", " ")
        tab.until(f"{REPLY} === 'vehicle2: stop: done: holding'")
        assert received[1:] == [("vehicle2", "stop")]
        tab.value("document.querySelector('#stop-all').click()")
        tab.until(f"{REPLY} === 'stop all: done: vehicle1: holding; vehicle2: holding'")
        assert sorted(received[2:]) == [("vehicle1", "stop"), ("vehicle2", "stop")]
        far = "for (let n = 0; n < 900; n++) extendTrails([{name: 'other', own_ned_m: [n, 0]}])"
        assert tab.value(f"{far}; state.trails.get('other').length") == 500
        tab.resize(390, 844, touch=True)
        assert rectangle(tab, "header")[3] < 0.2 * 844
        for number in (0, 1):
            tab.value(f"document.querySelectorAll('#fleet button')[{number}].click()")
            left, _, width, _ = rectangle(tab, "#fleet [aria-pressed=true]")
            assert left >= 0
            assert left + width <= 390
        stop, stop_all = rectangle(tab, "#stop"), rectangle(tab, "#stop-all")
        assert stop[0] + stop[2] <= stop_all[0]
        assert stop_all[0] + stop_all[2] <= 390
        assert tab.value("document.documentElement.scrollWidth") <= 390


LABEL = '<img src="x" onerror="document.body.remove()">'


def declare_query(service: Publisher, path: str, answer: Any) -> None:
    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, json.dumps(answer))

    service.session.declare_queryable(f"{ROOT}/{NAME}/{path}", reply)


def test_chat_shows_a_plan_and_flies_what_is_confirmed(window: Tab) -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    found = {**FOUND, "class_name": LABEL, "bearing_rad": 0.1, "ground_range_m": 9.0}
    with publishing() as (service, endpoint), dashboard_here(endpoint) as url, page_at(window, url) as tab:
        config = {"guidance": {"camera": None}, "detector": {"enabled": True}}
        declare_query(service, "config", config)
        declare_query(service, "commands", json_schema(["car", LABEL]))
        received = answering({NAME: service})
        sequence = itertools.count()

        def until(expression: str) -> None:
            def shown() -> bool:
                number = next(sequence)
                service.publish(
                    VEHICLE.key(NAME), {"yaw_rad": 0.0, "altitude_m": 5.0, "position_ned_m": None}
                )
                service.publish(DETECTIONS.key(NAME), frame(number, detections=[found]))
                service.image(number, jpeg)
                return bool(tab.value(expression))

            wait_for(shown)

        def ask(sentence: str) -> None:
            tab.value("document.querySelector('#sentence').focus()")
            tab.send("Input.insertText", text=sentence)
            tab.press("Enter", "\r")

        newest = "(document.querySelector('#chat li:last-child p:last-child')?.textContent ?? '')"
        waiting = "!document.querySelector('#plan').hidden"
        until("document.querySelector('#reader').textContent.includes('patterns')")
        # A label is text, never markup.
        ask("what do you see?")
        until(f"{newest}.startsWith('seen: black <img src=') && {newest}.includes('9 m away')")
        ask("take off to three metres")
        until(f"{newest} === 'takeoff altitude=3' && {waiting}")
        tab.value("document.querySelector('#decline').click()")
        until(f"{newest}.endsWith('not executed')")
        # The space bar stops, and ends the plan that waits.
        ask("take off to four metres")
        until(waiting)
        tab.press(" ", " ")
        until(f"{newest}.endsWith('ended by stop') && !({waiting})")
        wait_for(lambda: received == [(NAME, "stop")])
        ask("take off to five metres")
        until(waiting)
        tab.value("document.querySelector('#confirm').click()")
        until(f"{newest}.endsWith('done: holding')")
        assert received[1:] == [(NAME, "takeoff altitude=5")]
        # The same after a reload.
        tab.send("Page.reload")
        until(f"{OPENED} && true")
        until(f"{newest}.endsWith('done: holding')")
        assert tab.value("document.querySelectorAll('#chat li').length") == 4
