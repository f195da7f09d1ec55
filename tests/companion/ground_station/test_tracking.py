"""Clicks of a station: `select`, `follow`, their acknowledgements, and the status of what is selected."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station import tracking
from companion.ground_station.component import RequestTable
from companion.ground_station.tracking import Tracking
from companion.guidance import Select
from companion.guidance.grammar import parse
from tests.companion.ground_station.bodies import (
    HEIGHT,
    MS,
    NOW_NS,
    STATION,
    WIDTH,
    command,
    command_state,
    detection,
    frame,
    tracked_object,
)
from tests.vision.tracking.test_selection import CAR, Camera

POINT, RECTANGLE = mavlink.MAV_CMD_CAMERA_TRACK_POINT, mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE
STOP, INTERVAL = mavlink.MAV_CMD_CAMERA_STOP_TRACKING, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
ACCEPTED, DENIED, FAILED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_FAILED
IN_PROGRESS, CANCELLED = mavlink.MAV_RESULT_IN_PROGRESS, 6
REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
IDLE, ACTIVE, ERROR = 0, 1, 2
NAN = math.nan
PERSON = (100.0, 120.0, 180.0, 360.0)
SELECTED = {"success": True, "reason": "track 7, a person, is there", "track": 7, "class": "person"}


class Station:
    """A station, a camera's tracking, and the service behind it."""

    def __init__(self, *, steers: bool = True, follows: bool = False) -> None:
        self.requests = RequestTable()
        self.sent: list[str] = []
        self.texts: list[str] = []
        self.waiting: list[Callable[[Mapping[str, Any]], None]] = []
        self.now_ns = NOW_NS
        self.tracking = Tracking(
            "first",
            lambda: 100,
            self.requests,
            max_age_s=5.0,
            steers=steers,
            follows=follows,
            send=self._send,
            say=lambda _, text: self.texts.append(text),
        )

    def _send(self, text: str, on_reply: Callable[[Mapping[str, Any]], None]) -> None:
        self.sent.append(text)
        self.waiting.append(on_reply)

    def request(self, number: int, *parameters: float, **kind: Any) -> list[int]:
        """Send a command; returns the results that are acknowledged at once."""
        return results(self.requests.handle(command(number, *parameters, **kind), self.now_ns))

    def reply(self, **changes: Any) -> list[int]:
        """The service answers the oldest command; returns the acknowledged results."""
        self.waiting.pop(0)({**SELECTED, **changes})
        return results(self.pass_time(0))

    def pass_time(self, milliseconds: int) -> list[Any]:
        self.now_ns += milliseconds * MS
        return self.tracking.due(self.now_ns)

    def show(self, *detections: Any, sequence: int = 1, **others: Any) -> None:
        self.tracking.on_detections(frame(*detections, now_ns=self.now_ns, sequence=sequence, **others))

    def select(self, number: int = RECTANGLE, *parameters: float) -> None:
        """Select the person, whose track is 7."""
        self.show(detection(7, PERSON), sequence=0)
        self.request(number, *(parameters or (0.15, 0.25, 0.3, 0.75)))
        assert self.reply() == [ACCEPTED]

    def status(self, message_id: int = tracking.IMAGE_STATUS) -> Any:
        """What MAV_CMD_REQUEST_MESSAGE gives."""
        self.tracking.due(self.now_ns)
        (message,) = self.requests.replies[message_id](0)
        return message


def results(messages: list[Any]) -> list[int]:
    return [each.result for each in messages if each.get_type() == "COMMAND_ACK"]


def statuses(messages: list[Any]) -> list[Any]:
    return [each for each in messages if each.get_type() == "CAMERA_TRACKING_IMAGE_STATUS"]


# --- requests --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_int", [False, True])
def test_rectangle_is_selected_in_the_newest_image(as_int: bool) -> None:
    station = Station()
    station.show(detection(7, PERSON))
    assert station.request(RECTANGLE, 0.25, 0.5, 0.75, 1.0, as_int=as_int) == []
    selected = parse(station.sent[0])
    stamp_ns = float(NOW_NS - 30 * MS)
    assert selected == Select(0.25, 0.5, 0.5, 0.5, "first", stamp_ns)
    assert station.reply() == [ACCEPTED]
    assert station.sent[1:] == []


def test_without_a_recent_image_the_service_takes_its_newest() -> None:
    station = Station()
    station.show()
    station.pass_time(600)
    station.request(RECTANGLE, 0.25, 0.5, 0.75, 1.0)
    assert "stamp_ns" not in station.sent[0]


@pytest.mark.parametrize(
    ("number", "parameters", "named"),
    [
        (RECTANGLE, (NAN, 0.1, 0.2, 0.2), "left"),
        (RECTANGLE, (0.1, 0.1, 0.2, NAN), "bottom"),
        (RECTANGLE, (-0.1, 0.1, 0.2, 0.2), "left"),
        (RECTANGLE, (0.1, 0.1, 1.2, 0.2), "right"),
        (RECTANGLE, (0.1, math.inf, 0.2, 0.2), "top"),
        (RECTANGLE, (0.1, 0.1, 0.1, 0.2), "rectangle"),
        (RECTANGLE, (0.3, 0.1, 0.2, 0.2), "rectangle"),
        (RECTANGLE, (0.1, 0.3, 0.2, 0.2), "rectangle"),
        (POINT, (NAN, 0.5), "x"),
        (POINT, (0.5, 1.01), "y"),
        (POINT, (0.5, -1e-3), "y"),
        (POINT, (0.5, math.inf), "y"),
    ],
)
@pytest.mark.parametrize("as_int", [False, True])
def test_wrong_request_is_denied_with_the_reason(
    number: int, parameters: tuple[float, ...], named: str, as_int: bool
) -> None:
    station = Station()
    station.show(detection(7, PERSON))
    assert station.request(number, *parameters, as_int=as_int) == [DENIED]
    assert station.sent == []
    assert named in station.texts[0]


def test_another_cameras_number_is_not_ours() -> None:
    station = Station()
    assert station.request(RECTANGLE, 0.1, 0.1, 0.2, 0.2, 101) == [mavlink.MAV_RESULT_UNSUPPORTED]
    assert station.request(STOP, 101) == [mavlink.MAV_RESULT_UNSUPPORTED]
    assert station.request(RECTANGLE, 0.1, 0.1, 0.2, 0.2, 100) == []
    assert len(station.sent) == 1


def test_point_means_the_smallest_object_under_it() -> None:
    station = Station()
    whole, small = (50.0, 50.0, 400.0, 460.0), (110.0, 130.0, 150.0, 170.0)
    tentative = detection(9, (120.0, 140.0, 140.0, 160.0), track_state="tentative")
    station.show(detection(3, whole), detection(7, small), tentative)
    station.request(POINT, 130 / WIDTH, 150 / HEIGHT)
    selected = parse(station.sent[0])
    assert isinstance(selected, Select)
    got = (selected.x, selected.y, selected.width, selected.height)
    assert got == pytest.approx((110 / WIDTH, 130 / HEIGHT, 40 / WIDTH, 40 / HEIGHT), abs=2e-6)
    assert selected.stamp_ns == NOW_NS - 30 * MS


@pytest.mark.parametrize(("beside_px", "hit"), [(5.0, True), (8.0, False)])
def test_point_just_beside_a_box_means_it(beside_px: float, hit: bool) -> None:
    found = tracking.box_under((180 + beside_px) / WIDTH, 0.5, frame(detection(7, PERSON)))
    assert (found is not None) == hit


def test_point_on_no_object_selects_a_square_around_it() -> None:
    station = Station()
    station.show(detection(7, PERSON))
    station.request(POINT, 0.5, 0.5)
    station.reply()
    station.request(POINT, 0.99, 0.5, 0.1)
    first, cut = (parse(text) for text in station.sent)
    assert isinstance(first, Select)
    assert isinstance(cut, Select)
    assert (first.x, first.width) == pytest.approx((0.45, 0.1))
    assert first.width is not None
    assert first.height is not None
    assert first.width * WIDTH == pytest.approx(first.height * HEIGHT, abs=1e-3)
    assert (cut.x, cut.width) == pytest.approx((0.89, 0.11))


def test_error_of_the_service_is_the_result() -> None:
    station = Station()
    station.request(RECTANGLE, 0.1, 0.1, 0.9, 0.9)
    assert station.reply(success=False, reason="an even surface", track=None) == [FAILED]
    assert "an even surface" in station.texts[0]
    assert station.status().tracking_status == IDLE


def test_answer_after_half_a_second_is_announced() -> None:
    station = Station()
    station.request(RECTANGLE, 0.1, 0.1, 0.9, 0.9)
    assert results(station.pass_time(450)) == []
    (ack,) = station.pass_time(100)
    assert (ack.result, ack.progress) == (IN_PROGRESS, 255)
    assert (ack.target_system, ack.target_component) == STATION
    assert station.reply() == [ACCEPTED]
    assert results(station.pass_time(2000)) == []


def test_repeated_command_selects_once() -> None:
    station = Station()
    station.request(RECTANGLE, 0.1, 0.1, 0.9, 0.9)
    assert station.request(RECTANGLE, 0.1, 0.1, 0.9, 0.9) == [IN_PROGRESS]
    assert station.request(RECTANGLE, 0.2, 0.1, 0.9, 0.9) == [REJECTED]
    assert station.request(RECTANGLE, 0.1, 0.1, 0.9, 0.9, sender=(254, 190)) == [REJECTED]
    station.reply()
    station.pass_time(3000)
    assert station.request(RECTANGLE, 0.1, 0.1, 0.9, 0.9) == [ACCEPTED]
    assert len(station.sent) == 1
    station.pass_time(3000)
    assert station.request(RECTANGLE, 0.1, 0.1, 0.9, 0.9) == [ACCEPTED]
    station.pass_time(5000)
    assert station.request(RECTANGLE, 0.1, 0.1, 0.9, 0.9) == []
    assert len(station.sent) == 2


# --- flight ----------------------------------------------------------------------------------------------


def following() -> Station:
    """The person is followed."""
    station = Station(follows=True)
    station.select()
    assert station.sent[-1] == "follow track=7"
    station.tracking.on_command_state(command_state("s-2", "follow track=7", "accepted"))
    station.reply(id="s-2", state="in_progress")
    station.tracking.on_command_state(command_state("s-2", "follow track=7", "in_progress"))
    return station


def test_click_flies_nothing_by_default() -> None:
    station = Station()
    station.select()
    station.select(POINT, 0.2, 0.5)
    assert all(text.startswith("select ") for text in station.sent)
    assert station.request(STOP) == []
    assert station.reply(track=None) == [ACCEPTED]
    assert station.sent[-1] == "select camera=first"
    assert "hold" not in station.sent


def test_stop_holds_what_the_click_began() -> None:
    station = following()
    station.request(STOP)
    assert station.sent[-1] == "hold"
    assert station.reply() == []
    assert station.sent[-1] == "select camera=first"
    assert station.reply(track=None) == [ACCEPTED]
    assert station.status().tracking_status == IDLE


def test_stop_holds_nothing_that_another_commands() -> None:
    station = following()
    station.tracking.on_command_state(command_state("s-3", "goto north=5", "accepted"))
    station.tracking.on_command_state(command_state("s-2", "follow track=7", "ended", success=False))
    station.request(STOP)
    assert station.sent[-1] == "select camera=first"
    assert "hold" not in station.sent


def test_stop_holds_nothing_after_the_pilot_took_over() -> None:
    station = following()
    station.tracking.on_command_state(command_state("s-2", "follow track=7", "ended", success=False))
    station.request(STOP)
    assert "hold" not in station.sent


def test_stop_holds_after_another_command_was_refused() -> None:
    station = following()
    station.tracking.on_command_state(command_state("s-3", "goto north=900", "accepted"))
    station.tracking.on_command_state(command_state("s-3", "goto north=900", "ended", success=False))
    station.request(STOP)
    assert station.sent[-1] == "hold"


def test_stop_holds_a_follow_that_is_on_its_way() -> None:
    station = Station(follows=True)
    station.select()
    station.request(STOP)
    assert station.sent[-1] == "hold"


def test_stop_holds_nothing_of_a_new_service() -> None:
    station = following()
    station.tracking.on_service("s")
    station.tracking.on_service("t")
    station.request(STOP)
    assert "hold" not in station.sent


def test_stop_cancels_a_selection_before_it_flies() -> None:
    station = Station(follows=True)
    station.show(detection(7, PERSON))
    station.request(RECTANGLE, 0.1, 0.1, 0.9, 0.9)
    station.request(STOP)
    assert results(station.pass_time(0)) == [CANCELLED]
    station.reply()
    assert station.reply(track=None) == [ACCEPTED]
    assert [text.partition(" ")[0] for text in station.sent] == ["select", "select"]


def test_hold_that_is_refused_fails_the_stop() -> None:
    station = following()
    station.request(STOP)
    station.reply(success=False, reason="not in the air", command="hold")
    assert station.reply(track=None) == [FAILED]
    assert "not in the air" in station.texts[-1]


def test_refused_follow_is_said_and_the_selection_stays() -> None:
    station = Station(follows=True)
    station.select()
    station.reply(success=False, reason="not in the air")
    assert "not in the air" in station.texts[-1]
    station.request(STOP)
    assert "hold" not in station.sent


def test_repeated_click_does_not_fly_after_the_stop() -> None:
    station = following()
    station.request(STOP)
    station.reply()
    station.reply(track=None)
    sent = len(station.sent)
    station.pass_time(3000)
    click = (RECTANGLE, 0.15, 0.25, 0.3, 0.75)
    assert station.request(*click) == [REJECTED]
    assert len(station.sent) == sent
    station.pass_time(5000)
    assert station.request(*click) == []


def test_click_of_a_second_station_does_not_hide_a_repeated_one() -> None:
    station = following()
    station.request(RECTANGLE, 0.2, 0.2, 0.4, 0.4, sender=(254, 190))
    station.reply(track=8)
    sent = len(station.sent)
    assert station.request(RECTANGLE, 0.15, 0.25, 0.3, 0.75) == [ACCEPTED]
    assert len(station.sent) == sent


def test_selection_that_comes_late_is_not_followed() -> None:
    station = Station(follows=True)
    station.show(detection(7, PERSON))
    station.request(RECTANGLE, 0.15, 0.25, 0.3, 0.75)
    station.now_ns += tracking.FOLLOW_WITHIN_NS + MS
    assert station.reply() == [ACCEPTED]
    assert len(station.sent) == 1
    assert "not followed" in station.texts[0]


def test_click_is_not_followed_after_a_change_of_mode() -> None:
    station = Station(follows=True)
    station.tracking.on_vehicle({"mode": "hold"})  # type: ignore[typeddict-item]
    station.request(RECTANGLE, 0.15, 0.25, 0.3, 0.75)
    station.tracking.on_vehicle({"mode": "position"})  # type: ignore[typeddict-item]
    assert station.reply() == [ACCEPTED]
    assert len(station.sent) == 1
    assert "position" in station.texts[0]


def test_click_from_before_a_standstill_flies_nothing() -> None:
    station = Station(follows=True)
    station.show(detection(7, PERSON))
    station.request(RECTANGLE, 0.15, 0.25, 0.3, 0.75)
    station.tracking.abandon_clicks()
    assert results(station.pass_time(0)) == [FAILED]
    station.reply()
    station.pass_time(100)
    assert len(station.sent) == 1


def test_restarted_process_holds_what_a_click_began() -> None:
    station = Station(follows=True)
    station.tracking.on_command_state(command_state("s-1", "select x=0", "ended", "track 7, a person"))
    station.tracking.on_command_state(command_state("s-2", "follow track=7", "in_progress"))
    station.request(STOP)
    assert station.sent == ["hold"]


@pytest.mark.parametrize("text", ["approach track=7", "approach target", "orbit class=target radius=5"])
@pytest.mark.parametrize("request_", [(STOP,), (RECTANGLE, 0.5, 0.5, 0.6, 0.6), (POINT, 0.5, 0.5)])
def test_object_of_anothers_command_stays_selected(text: str, request_: tuple[Any, ...]) -> None:
    station = Station(follows=True)
    station.select()
    station.reply(success=False, reason="not in the air")
    station.show(detection(7, PERSON, class_name="target"), sequence=2)
    station.tracking.on_command_state(command_state("s-3", text, "in_progress"))
    sent = len(station.sent)
    assert station.request(*request_) == [DENIED]
    assert len(station.sent) == sent
    assert text in station.texts[-1]
    station.tracking.on_command_state(command_state("s-3", text, "ended"))
    assert station.request(*request_) == []


def test_detected_object_of_anothers_command_may_be_deselected() -> None:
    station = Station()
    station.select()
    station.tracking.on_command_state(command_state("s-3", "approach track=7", "in_progress"))
    assert station.request(STOP) == []


def test_point_on_no_object_is_not_followed() -> None:
    station = Station(follows=True)
    station.show(detection(7, PERSON))
    station.request(POINT, 0.9, 0.1)
    assert station.reply(track=8, **{"class": "target"}) == [ACCEPTED]
    assert len(station.sent) == 1
    assert "not followed" in station.texts[0]


def test_track_of_another_camera_is_not_followed() -> None:
    station = Station(follows=True, steers=False)
    station.select()
    assert len(station.sent) == 1
    assert "not followed" in station.texts[0]


# --- status ----------------------------------------------------------------------------------------------


def test_status_has_the_box_of_the_frame() -> None:
    station = Station()
    station.select()
    station.pass_time(100)
    station.show(detection(7, PERSON))
    (status,) = statuses(station.pass_time(0))
    assert (status.tracking_status, status.tracking_mode) == (ACTIVE, mavlink.CAMERA_TRACKING_MODE_RECTANGLE)
    assert status.target_data == mavlink.CAMERA_TRACKING_TARGET_DATA_IN_STATUS
    box = (status.rec_top_x, status.rec_top_y, status.rec_bottom_x, status.rec_bottom_y)
    assert box == pytest.approx((100 / WIDTH, 120 / HEIGHT, 180 / WIDTH, 360 / HEIGHT))
    assert math.isnan(status.point_x)
    assert math.isnan(status.radius)


def test_status_of_a_point_is_a_point() -> None:
    station = Station()
    station.select(POINT, 0.2, 0.5)
    status = station.status()
    assert status.tracking_mode == mavlink.CAMERA_TRACKING_MODE_POINT
    assert (status.point_x, status.point_y) == pytest.approx((140 / WIDTH, 240 / HEIGHT))
    assert status.radius == pytest.approx(120 / WIDTH)
    assert math.isnan(status.rec_top_x)


def test_each_frame_is_sent_once_at_the_interval() -> None:
    station = Station()
    station.select()
    sent = []
    for sequence in range(1, 31):  # 30 Hz
        station.show(detection(7, PERSON), sequence=sequence)
        sent += statuses(station.pass_time(33))
    assert 9 <= len(sent) <= 11
    sent = []
    station.request(INTERVAL, tracking.IMAGE_STATUS, 20_000)
    for sequence in range(31, 41):
        station.show(detection(7, PERSON), sequence=sequence)
        sent += statuses(station.pass_time(17)) + statuses(station.pass_time(16))
    assert len(sent) == 7  # of 330 ms


def test_interval_ends_and_returns_to_the_default() -> None:
    station = Station()
    assert station.request(INTERVAL, tracking.IMAGE_STATUS, -1) == [ACCEPTED]
    assert station.request(INTERVAL, tracking.GEO_STATUS, 200_000) == [ACCEPTED]
    assert station.request(INTERVAL, 9999, 1000) == [mavlink.MAV_RESULT_UNSUPPORTED]
    station.select()
    station.pass_time(200)
    station.show(detection(7, PERSON))
    assert [each.get_type() for each in station.pass_time(0)] == ["CAMERA_TRACKING_GEO_STATUS"]
    station.request(INTERVAL, tracking.IMAGE_STATUS, 0)
    assert len(statuses(station.pass_time(50))) == 1


def test_old_box_is_an_error_and_not_sent() -> None:
    station = Station()
    station.select()
    assert statuses(station.pass_time(110)) == []  # 140 ms after its capture
    assert station.status().tracking_status == ACTIVE
    assert statuses(station.pass_time(10)) == []
    assert station.status().tracking_status == ERROR
    assert statuses(station.pass_time(380)) == []
    (status,) = statuses(station.pass_time(20))
    assert (status.tracking_status, status.target_data) == (ERROR, 0)
    assert math.isnan(status.rec_top_x)
    station.show(detection(8, PERSON), sequence=5)
    assert station.status().tracking_status == ERROR
    station.show(detection(7, PERSON), sequence=6)
    assert station.status().tracking_status == ACTIVE


def test_slow_camera_has_no_errors_between_its_frames() -> None:
    station = Station()
    station.select()
    sent = []
    for sequence in range(1, 11):  # 4 Hz
        station.show(detection(7, PERSON), sequence=sequence)
        sent += [message for _ in range(5) for message in statuses(station.pass_time(50))]
    assert {each.tracking_status for each in sent} == {ACTIVE}
    assert len(sent) >= 9


def test_slow_computer_shows_its_boxes() -> None:
    station = Station()
    station.show(detection(7, PERSON), sequence=0, delay_ms=300)
    station.request(RECTANGLE, 0.15, 0.25, 0.3, 0.75)
    station.reply()
    station.show(detection(7, PERSON), sequence=1, delay_ms=300)
    assert station.status().tracking_status == ACTIVE
    station.pass_time(100)
    assert station.status().tracking_status == ERROR


def test_box_that_comes_late_once_is_not_sent() -> None:
    station = Station()
    station.select()
    for sequence in range(1, 20):
        station.show(detection(7, PERSON), sequence=sequence)
        station.pass_time(100)
    station.show(detection(7, PERSON), sequence=20, delay_ms=160)
    assert statuses(station.pass_time(0)) == []
    assert station.status().tracking_status == ERROR


def test_end_of_the_track_is_idle_and_said_once() -> None:
    station = Station()
    station.select()
    station.pass_time(4900)
    station.show(sequence=1)
    assert station.status().tracking_status == ERROR
    for sequence in (2, 3):
        station.pass_time(200)
        station.show(sequence=sequence)
    messages = [message for _ in range(60) for message in statuses(station.pass_time(50))]
    assert {each.tracking_status for each in messages} == {IDLE}
    assert 18 <= len(messages) <= 22
    assert len(station.texts) == 1
    assert "track 7" in station.texts[0]


def test_new_selection_does_not_complain_about_the_old_one() -> None:
    station = Station()
    station.select()
    station.request(RECTANGLE, 0.1, 0.1, 0.2, 0.2)
    station.reply(track=8)
    station.pass_time(4000)
    station.show(detection(8, PERSON), sequence=1)
    station.pass_time(4000)
    station.show(detection(8, PERSON), sequence=2)
    assert station.status().tracking_status == ACTIVE
    assert station.texts == []


def test_object_is_followed_when_its_track_id_changes() -> None:
    station = Station()
    station.select()
    moved = (110.0, 120.0, 190.0, 360.0)
    station.show(detection(12, moved), objects=[tracked_object(1, [7, 12])], sequence=1)
    status = station.status()
    assert status.tracking_status == ACTIVE
    assert status.rec_top_x == pytest.approx(110 / WIDTH)
    station.show(detection(7, PERSON), detection(12, moved), sequence=2)
    assert station.status().rec_top_x == pytest.approx(110 / WIDTH)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("select x=0.1 y=0.1 width=0.2 height=0.2", True),
        ("select x=0.1 y=0.1 width=0.2 height=0.2 camera=first", True),
        ("select x=0.1 y=0.1 width=0.2 height=0.2 camera=down", False),
    ],
)
def test_selection_of_another_operator_is_shown(text: str, shown: bool) -> None:
    station = Station()
    station.show(detection(7, PERSON))
    station.tracking.on_command_state(command_state("s-1", text, "ended", "track 7, a person, is there"))
    assert (station.status().tracking_status == ACTIVE) == shown
    station.tracking.on_command_state(
        command_state("s-2", "select camera=first", "ended", "nothing was selected")
    )
    assert station.status().tracking_status == IDLE


def test_reason_of_a_selection_names_its_track() -> None:
    camera = Camera()
    camera.show(5)
    for rectangle, track_id in ((CAR, 1), ((150.0, 200.0, 210.0, 240.0), 2)):
        answer = camera.select(*rectangle)
        station = Station()
        text = "select x=0.1 y=0.1 width=0.2 height=0.2"
        station.tracking.on_command_state(command_state("s-1", text, "ended", answer.reason))
        assert station.tracking.selection is not None
        assert station.tracking.selection.track_id == answer.track_id == track_id


def test_geo_status_has_position_velocity_and_errors() -> None:
    station = Station()
    station.select()
    station.show(detection(7, PERSON), objects=[tracked_object(1, [7])], sequence=2)
    status = station.status(tracking.GEO_STATUS)
    assert (status.tracking_status, status.lat, status.lon) == (ACTIVE, 473977419, 85455938)
    assert (status.alt, status.dist) == (488.125, 10.0)
    assert (status.vel_n, status.vel_e, status.h_acc, status.vel_acc) == (1.0, -1.0, 2.0, 0.5)
    assert status.hdg == pytest.approx(-math.pi / 4)
    assert all(map(math.isnan, (status.v_acc, status.vel_d, status.hdg_acc)))


def test_geo_status_without_a_position_has_no_number() -> None:
    station = Station()
    station.select()
    status = station.status(tracking.GEO_STATUS)
    assert (status.lat, status.lon) == (2**31 - 1, 2**31 - 1)
    unknown = (status.alt, status.h_acc, status.vel_n, status.vel_e, status.hdg)
    assert all(map(math.isnan, unknown))
