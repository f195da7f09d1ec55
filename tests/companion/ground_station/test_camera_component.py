"""A camera component: requests of both spellings, heartbeat, captures as commands."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station.component import Message
from tests.companion.ground_station.station_harness import (
    CAMERA_ID,
    STATION,
    SYSTEM,
    CameraHarness,
    S,
    command_int,
    command_long,
    jpeg,
    received,
    types,
    vehicle_body,
)

OWN_COMMANDS = {
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: "CAMERA_INFORMATION",
    mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS: "CAMERA_SETTINGS",
    mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION: "STORAGE_INFORMATION",
    mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: "CAMERA_CAPTURE_STATUS",
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: "VIDEO_STREAM_INFORMATION",
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS: "VIDEO_STREAM_STATUS",
}
BY_MESSAGE = (*OWN_COMMANDS.values(), "CAMERA_FOV_STATUS")
# The old commands say "all" with 0 where they have the number of a stream, and else "request" with 1.
REQUESTS = [
    *(
        pytest.param(
            number, (0.0 if "STREAM" in name or "STORAGE" in name else 1.0, 1.0), name, id=f"{number}"
        )
        for number, name in OWN_COMMANDS.items()
    ),
    *(
        pytest.param(
            mavlink.MAV_CMD_REQUEST_MESSAGE,
            (float(getattr(mavlink, f"MAVLINK_MSG_ID_{name}")), 0.0),
            name,
            id=f"512 {name}",
        )
        for name in BY_MESSAGE
    ),
]
ADDRESSED = [(SYSTEM, CAMERA_ID), (0, CAMERA_ID), (SYSTEM, 0), (0, 0)]
NOT_ADDRESSED = [(2, CAMERA_ID), (2, 0), (SYSTEM, CAMERA_ID + 1), (SYSTEM, 1)]
SPELLINGS = [command_long, command_int]


@pytest.fixture
def harness(tmp_path: Path) -> CameraHarness:
    return CameraHarness(tmp_path)


def result_of(answers: list[Message]) -> int:
    ack = answers[0]
    assert ack.get_type() == "COMMAND_ACK"
    assert (ack.target_system, ack.target_component) == STATION
    return int(ack.result)


@pytest.mark.parametrize("target", ADDRESSED)
@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize(("number", "parameters", "name"), REQUESTS)
def test_request_has_acknowledgement_then_its_message(
    harness: CameraHarness,
    number: int,
    parameters: tuple[float, ...],
    name: str,
    spelling: object,
    target: tuple[int, int],
) -> None:
    assert callable(spelling)
    answers = harness.ask(spelling(number, *parameters, target=target))
    assert types(answers) == ["COMMAND_ACK", name]
    assert result_of(answers) == mavlink.MAV_RESULT_ACCEPTED
    assert answers[0].command == number
    assert answers[1].get_srcComponent() == CAMERA_ID


@pytest.mark.parametrize("target", NOT_ADDRESSED)
@pytest.mark.parametrize(("number", "parameters", "name"), REQUESTS)
def test_request_for_another_component_has_no_answer(
    harness: CameraHarness, number: int, parameters: tuple[float, ...], name: str, target: tuple[int, int]
) -> None:
    assert harness.ask(command_long(number, *parameters, target=target)) == [], name


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize(
    "number", [mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_SET_CAMERA_ZOOM, 12345]
)
def test_unknown_command_is_unsupported(harness: CameraHarness, number: int, spelling: object) -> None:
    assert callable(spelling)
    assert result_of(harness.ask(spelling(number))) == mavlink.MAV_RESULT_UNSUPPORTED
    # To all components: the autopilot answers it.
    assert harness.ask(spelling(number, target=(SYSTEM, 0))) == []


def test_unknown_message_is_unsupported(harness: CameraHarness) -> None:
    answers = harness.ask(command_long(512, mavlink.MAVLINK_MSG_ID_ATTITUDE))
    assert result_of(answers) == mavlink.MAV_RESULT_UNSUPPORTED
    assert harness.ask(command_long(512, mavlink.MAVLINK_MSG_ID_ATTITUDE, target=(SYSTEM, 0))) == []


@pytest.mark.parametrize(
    ("number", "parameters"),
    [
        (512, (269.0, 3.0)),
        (512, (270.0, 3.0)),
        (512, (261.0, 2.0)),
        (512, (263.0, 0.0)),
        (512, (269.0, -1.0)),
        (512, (269.0, math.inf)),
        (mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, (3.0,)),
        (mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS, (3.0,)),
        (mavlink.MAV_CMD_VIDEO_START_STREAMING, (3.0,)),
        (mavlink.MAV_CMD_SET_CAMERA_MODE, (0.0, 7.0)),
        (mavlink.MAV_CMD_IMAGE_START_CAPTURE, (0.0, -1.0, 1.0)),
        (mavlink.MAV_CMD_IMAGE_START_CAPTURE, (0.0, math.inf, 2.0)),
    ],
)
def test_number_that_does_not_exist_is_denied(
    tmp_path: Path, number: int, parameters: tuple[float, ...]
) -> None:
    answers = CameraHarness(tmp_path, streams=2).ask(command_long(number, *parameters))
    assert types(answers) == ["COMMAND_ACK"]
    assert result_of(answers) == mavlink.MAV_RESULT_DENIED


def test_stream_zero_is_all_streams(tmp_path: Path) -> None:
    harness = CameraHarness(tmp_path, streams=3)
    answers = harness.ask(command_long(512, mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION, 0))[1:]
    assert [(each.stream_id, each.count) for each in answers] == [(1, 3), (2, 3), (3, 3)]
    (second,) = harness.ask(command_long(512, mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION, 2))[1:]
    assert (second.stream_id, second.uri) == (2, "rtsp://127.0.0.1:8554/1")
    assert result_of(harness.ask(command_long(mavlink.MAV_CMD_VIDEO_START_STREAMING, 0))) == 0


def test_parameters_that_are_not_a_number_are_not_given(harness: CameraHarness) -> None:
    answers = harness.ask(command_long(512, mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION, *[math.nan] * 6))
    assert types(answers) == ["COMMAND_ACK", "STORAGE_INFORMATION"]


def test_flags_say_what_it_can_do(tmp_path: Path) -> None:
    flags = CameraHarness(tmp_path).ask(command_long(521, 1))[1].flags
    assert flags & mavlink.CAMERA_CAP_FLAGS_CAPTURE_IMAGE
    assert flags & mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
    without = CameraHarness(tmp_path, streams=0).ask(command_long(521, 1))[1].flags
    assert not without & mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM


def test_lens_that_becomes_known_is_announced(harness: CameraHarness) -> None:
    assert harness.ask(command_long(521, 1))[1].resolution_h == 0
    info = {"width": 640, "height": 480, "k": [320.0, 0, 0, 0, 320.0, 0, 0, 0, 1]}
    harness.camera.on_camera_info(info)  # type: ignore[arg-type]
    (message,) = [each for each in harness.due() if each.get_type() == "CAMERA_INFORMATION"]
    assert (message.resolution_h, message.resolution_v) == (640, 480)
    harness.camera.on_camera_info(info)  # type: ignore[arg-type]
    assert "CAMERA_INFORMATION" not in types(harness.due())
    fov = harness.ask(command_long(512, mavlink.MAVLINK_MSG_ID_CAMERA_FOV_STATUS))[1]
    assert fov.hfov == pytest.approx(90.0)


def test_heartbeat_says_whether_the_service_runs(tmp_path: Path) -> None:
    harness = CameraHarness(tmp_path, status=False)
    states = []
    for tick in range(20 * 8):
        harness.now_ns += S // 20
        if 40 <= tick < 100:
            harness.camera.on_status(harness.now_ns)
        states += [each.system_status for each in harness.due() if each.get_type() == "HEARTBEAT"]
    boot, active, critical = (
        mavlink.MAV_STATE_BOOT,
        mavlink.MAV_STATE_ACTIVE,
        mavlink.MAV_STATE_CRITICAL,
    )
    # Status from 2.05 s to 5 s, and fresh for 3 s more.
    assert states == [boot, boot, active, active, active, active, active, critical]


def test_mode_is_set_and_reported(harness: CameraHarness) -> None:
    answers = harness.ask(command_long(mavlink.MAV_CMD_SET_CAMERA_MODE, 0, mavlink.CAMERA_MODE_VIDEO))
    assert types(answers) == ["COMMAND_ACK", "CAMERA_SETTINGS"]
    assert harness.ask(command_long(522, 1))[1].mode_id == mavlink.CAMERA_MODE_VIDEO


def test_message_comes_at_the_interval_asked_for(harness: CameraHarness) -> None:
    status = mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS
    assert result_of(harness.ask(command_long(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, status, 200_000))) == 0

    def in_a_second() -> int:
        count = 0
        for _ in range(20):
            harness.now_ns += S // 20
            count += types(harness.due()).count("CAMERA_CAPTURE_STATUS")
        return count

    assert in_a_second() in (5, 6)
    harness.ask(command_long(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, status, -1))
    assert in_a_second() == 0
    unknown = harness.ask(command_long(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 200_000))
    assert result_of(unknown) == mavlink.MAV_RESULT_UNSUPPORTED


# --- photos and videos -----------------------------------------------------------------------------------


def take_photo(harness: CameraHarness, *parameters: float, confirmation: int = 0) -> int:
    answers = harness.ask(
        command_long(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, *parameters, confirmation=confirmation)
    )
    assert types(answers) == ["COMMAND_ACK"]
    return result_of(answers)


def test_photo_is_a_file_and_a_message_with_its_place(harness: CameraHarness, tmp_path: Path) -> None:
    at_ns = harness.now_ns + S // 10
    harness.positions.on_vehicle(vehicle_body(at_ns - S // 20, 47.0, 10.0))
    harness.positions.on_vehicle(vehicle_body(at_ns + S // 20, 47.002, 20.0))
    half = math.sqrt(0.5)
    turned: Any = {"captured_ns": at_ns, "transforms": [{"rotation_wxyz": [half, 0.0, 0.0, half]}]}
    harness.positions.on_transforms(turned)
    assert take_photo(harness, 0, 1) == mavlink.MAV_RESULT_ACCEPTED
    assert harness.captures.is_wanted
    harness.captures.on_image(b"before the command", harness.now_ns - 1, harness.now_ns)
    data = jpeg()
    harness.captures.on_image(data, at_ns, harness.now_ns)
    assert not harness.captures.is_wanted
    captured = harness.sent_until("CAMERA_IMAGE_CAPTURED")[-2]
    (file,) = (tmp_path / "photos").iterdir()
    assert file.read_bytes() == data
    assert file.stat().st_mode & 0o077 == 0
    assert captured.file_url == f"photos/{file.name}"
    assert (captured.capture_result, captured.image_index) == (1, 0)
    assert (captured.lat, captured.lon) == (470_010_000, 80_000_000)
    assert (captured.alt, captured.relative_alt) == (515_000, 15_000)
    assert captured.time_boot_ms == at_ns // 1_000_000
    # The optical axis, z, stays down: the camera looks down, its upper edge north.
    assert captured.q == pytest.approx([half, 0.0, -half, 0.0], abs=1e-6)
    again = harness.ask(command_long(512, mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED, 0))
    assert again[1].to_dict() == captured.to_dict()
    assert harness.ask(command_long(527, 1))[1].image_count == 1


def test_photo_without_a_known_place_says_so(harness: CameraHarness) -> None:
    take_photo(harness, 0, 1)
    harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
    captured = harness.sent_until("CAMERA_IMAGE_CAPTURED")[-2]
    assert (captured.capture_result, captured.lat, captured.relative_alt) == (1, 2**31 - 1, 2**31 - 1)
    assert all(map(math.isnan, captured.q))


@pytest.mark.parametrize(
    ("first", "second", "count"),
    [
        ((0, 1, 0), (0, 1, 0), 2),  # two commands
        ((0, 1, 7), (0, 1, 7), 1),  # the same capture number
        ((0, 1, 7), (0, 1, 8), 2),
    ],
)
def test_capture_number_marks_a_repeated_photo(
    harness: CameraHarness, first: tuple[float, ...], second: tuple[float, ...], count: int
) -> None:
    for parameters in (first, second):
        assert take_photo(harness, *parameters) == mavlink.MAV_RESULT_ACCEPTED
        harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
        harness.now_ns += S // 2
    assert harness.captures.image_count == count


def test_repeated_command_takes_no_second_photo(harness: CameraHarness) -> None:
    for confirmation in range(3):
        assert take_photo(harness, 0, 1, confirmation=confirmation) == mavlink.MAV_RESULT_ACCEPTED
        harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
        harness.now_ns += S
    assert harness.captures.image_count == 1
    # The first one was lost.
    harness.now_ns += 20 * S
    harness.due()
    assert take_photo(harness, 0, 1, confirmation=1) == mavlink.MAV_RESULT_ACCEPTED
    harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
    assert harness.captures.image_count == 2


def test_photos_at_an_interval_until_stopped(harness: CameraHarness, tmp_path: Path) -> None:
    take_photo(harness, 0.5, 0)
    for _ in range(40):  # 4 s
        harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
        harness.captures._executor.submit(lambda: None).result()
        harness.due()
        harness.now_ns += S // 10
    status = harness.ask(command_long(527, 1))[1]
    assert (status.image_status, status.image_interval) == (2, 0.5)
    assert harness.captures.image_count == 8
    assert types(harness.ask(command_long(mavlink.MAV_CMD_IMAGE_STOP_CAPTURE))) == [
        "COMMAND_ACK",
        "CAMERA_CAPTURE_STATUS",
    ]
    assert not harness.captures.is_wanted
    assert len(list((tmp_path / "photos").iterdir())) == 8


def test_video_is_recorded_and_reported(harness: CameraHarness, tmp_path: Path) -> None:
    assert result_of(harness.ask(command_long(mavlink.MAV_CMD_VIDEO_START_CAPTURE))) == 0
    for _ in range(10):
        harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
        harness.captures._executor.submit(lambda: None).result()
        harness.due()
        harness.now_ns += S // 10
    status = harness.ask(command_long(527, 1))[1]
    assert (status.video_status, status.recording_time_ms) == (1, 1000)
    assert harness.ask(command_long(mavlink.MAV_CMD_VIDEO_STOP_CAPTURE))[1].video_status == 0
    harness.captures.close()
    (file,) = (tmp_path / "videos").iterdir()
    assert file.suffix == ".webm"
    assert file.stat().st_size > 100
    assert harness.warnings == []


@pytest.mark.parametrize("number", [mavlink.MAV_CMD_IMAGE_START_CAPTURE, mavlink.MAV_CMD_VIDEO_START_CAPTURE])
def test_capture_without_a_folder_is_denied_and_said(number: int) -> None:
    harness = CameraHarness(None)
    answers = harness.ask(command_long(number, 0, 0, 1))
    assert types(answers) == ["COMMAND_ACK"]
    assert result_of(answers) == mavlink.MAV_RESULT_DENIED
    assert "recording.directory" in harness.warnings[0]
    assert harness.ask(command_long(525, 0, 1))[1].status == mavlink.STORAGE_STATUS_EMPTY


def test_capture_while_the_service_is_away_is_rejected(tmp_path: Path) -> None:
    harness = CameraHarness(tmp_path, status=False)
    assert take_photo(harness, 0, 1) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED


def test_photo_without_an_image_fails(harness: CameraHarness) -> None:
    take_photo(harness, 0, 1)
    harness.now_ns += 6 * S
    captured = next(each for each in harness.due() if each.get_type() == "CAMERA_IMAGE_CAPTURED")
    assert (captured.capture_result, captured.file_url) == (0, "")
    assert len(harness.warnings) == 1
    assert not harness.captures.is_wanted


def test_storage_has_the_free_space_of_the_disk(harness: CameraHarness) -> None:
    harness.now_ns += 2 * S
    harness.due()
    harness.captures._executor.submit(lambda: None).result()
    harness.due()
    storage = harness.ask(command_long(525, 1, 1))[1]
    assert storage.status == mavlink.STORAGE_STATUS_READY
    assert 0 < storage.available_capacity < storage.total_capacity


# --- stations --------------------------------------------------------------------------------------------


def test_new_station_gets_everything_unasked(harness: CameraHarness) -> None:
    heartbeat = received(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))

    def sent_in(seconds: int) -> list[str]:
        sent = []
        for _ in range(20 * seconds):
            harness.now_ns += S // 20
            sent += types(harness.due())
            if harness.now_ns % S < S // 20:
                harness.camera.handle(heartbeat, harness.now_ns)
        return sent

    first = sent_in(12)
    assert {"CAMERA_INFORMATION", *OWN_COMMANDS.values()} <= set(first)
    later = set(sent_in(12))
    assert later == {"HEARTBEAT"}
    harness.now_ns += 5 * S  # it was away
    assert sent_in(12).count("CAMERA_INFORMATION") == first.count("CAMERA_INFORMATION")
