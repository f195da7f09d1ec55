"""The bus as ROS messages: every topic, every axis, the stamp of the capture; the unknown is not sent."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from companion.bus.messages import transforms_message
from companion.bus.topics import (
    CAMERA_INFO,
    CLOUD,
    DETECTIONS,
    IMAGE,
    LABELS,
    LARGE_TOPICS,
    STATUS,
    TRANSFORMS,
    VEHICLE,
    Topic,
)
from companion.bus.vehicle_messages import vehicle_message
from companion.guidance.objects.from_detections import StateHistory
from companion.ros2.cdr import decode
from companion.ros2.definitions import DEFINITIONS
from companion.ros2.messages import OUTPUT_TOPICS, Messages, RosTopic, frame_prefix, ros_name, topic_name
from companion.vehicle.gimbal import GimbalState
from companion.vehicle.state import VehicleState
from tests.companion.ros2.bus_samples import (
    CAPTURED_NS,
    JPEG,
    PIXELS,
    POINTS,
    body_of,
    detection,
    object_in_frame,
    payload_for,
    payload_of,
)
from tests.companion.ros2.message_readers import equal
from vision.attitude import quaternion_from_euler
from vision.camera_model import CameraModel, CameraMount
from vision.image_file import decode_image
from vision.rotation import matrix_from_quaternion

OFFSET_NS = 1_700_000_000_000_000_000
MESSAGES = Messages("drone1/", lambda stamp_ns: stamp_ns + OFFSET_NS)
BY_NAME = {topic.name: topic for topic in OUTPUT_TOPICS}
# By REP 103, as matrices: rows are ROS's axes in ours.
ENU_FROM_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLU_FROM_FRD = np.diag([1, -1, -1])
STATE = VehicleState(
    heartbeat_ns=CAPTURED_NS,
    position_ns=CAPTURED_NS - 40_000_000,
    global_ns=CAPTURED_NS - 300_000_000,
    attitude_ns=CAPTURED_NS,
    position_ned_m=(1.0, 2.0, -3.0),
    velocity_ned_mps=(0.0, 0.0, 0.0),
    attitude=quaternion_from_euler(0.1, -0.2, 0.7),
    latitude_deg=47.4,
    longitude_deg=8.5,
    altitude_amsl_m=500.0,
)
UNIT = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1)


def converted(name: str, payload: bytes, attachment: bytes | None = None, camera: str | None = None) -> Any:
    cdr = MESSAGES.convert(BY_NAME[name], camera, payload, attachment)
    return None if cdr is None else decode(BY_NAME[name].type_name, cdr)


def of(name: str, camera: str | None = None, **changes: Any) -> Any:
    return converted(name, *payload_of(BY_NAME[name].source, **changes), camera)


def stamp_ns(header: dict[str, Any]) -> int:
    return int(header["stamp"]["sec"] * 1_000_000_000 + header["stamp"]["nanosec"])


def matrix(wxyz: dict[str, float]) -> NDArray[np.float64]:
    return matrix_from_quaternion((wxyz["w"], wxyz["x"], wxyz["y"], wxyz["z"]))


def xyz(vector: dict[str, float]) -> list[float]:
    return [vector["x"], vector["y"], vector["z"]]


def variances(result: dict[str, Any]) -> list[float]:
    covariance = np.reshape(result["pose"]["covariance"], (6, 6))
    np.testing.assert_array_equal(covariance, np.diag(np.diag(covariance)))
    return [float(each) for each in np.diag(covariance)]


@pytest.mark.parametrize("topic", OUTPUT_TOPICS, ids=lambda topic: topic.name)
def test_every_topic_is_made_with_the_stamp_of_its_message(topic: RosTopic) -> None:
    payload, attachment = payload_for(topic)
    message = converted(topic.name, payload, attachment)
    assert message.keys() == {line.split()[1] for line in DEFINITIONS[topic.type_name].splitlines()}
    if topic.source == LABELS:
        return
    body = json.loads(attachment or payload)
    headers = (
        [each["header"] for each in message["transforms"]] if topic.name == "/tf" else [message["header"]]
    )
    headers += [each["header"] for each in message.get("detections", ())]
    age_of = {"fix": "global_age_s", "pose": "position_age_s"}.get(topic.name)
    age_ns = round(body[age_of] * 1e9) if age_of else 0
    expected = body.get("captured_ns", body.get("stamp_ns", 0)) - age_ns + OFFSET_NS
    assert {stamp_ns(header) for header in headers} == {expected}


def test_names_are_valid_in_ros() -> None:
    assert ros_name("drone-1.a") == "drone_1_a"
    assert (ros_name("4x4"), ros_name("_x_"), ros_name("-")) == ("n4x4", "x", "n")
    assert topic_name(BY_NAME["image/compressed"], "front-left") == "cameras/front_left/image/compressed"
    assert topic_name(BY_NAME["detections"], None) == "detections"
    assert topic_name(BY_NAME["/tf"], "down") == "/tf"
    assert (frame_prefix("drone1"), frame_prefix("")) == ("drone1/", "")


def test_latched_is_what_the_bus_keeps_one_of() -> None:
    assert [topic.name for topic in OUTPUT_TOPICS if topic.latched] == ["camera_info"]
    assert CAMERA_INFO.cached == 1


def test_detection_has_class_score_track_and_box() -> None:
    found = detection(class_name="Käfer", confidence=0.83, track_id=17, xyxy=[10.0, 20.0, 40.0, 60.0],
                      center=[25.0, 40.0], nearest_camera_m=[0.5, -0.25, 8.0], depth_sigma_m=0.2)  # fmt: skip
    message = of("detections", camera="down", detections=[found], captured_ns=CAPTURED_NS)
    assert message["header"]["frame_id"] == "drone1/cameras/down_optical"
    (each,) = message["detections"]
    assert each["header"] == message["header"]
    (result,) = each["results"]
    assert result["hypothesis"] == {"class_id": "Käfer", "score": 0.83}
    assert xyz(result["pose"]["pose"]["position"]) == [0.5, -0.25, 8.0]
    assert variances(result) == [1e6, 1e6, 0.2**2, 1e6, 1e6, 1e6]
    assert each["id"] == "17"
    box = each["bbox"]
    assert (box["center"]["position"], box["center"]["theta"]) == ({"x": 25.0, "y": 40.0}, 0.0)
    assert (box["size_x"], box["size_y"]) == (30.0, 40.0)


def test_detection_without_track_and_depth_has_no_id_and_no_position() -> None:
    message = of("detections", detections=[detection(track_id=None, nearest_camera_m=None)])
    (each,) = message["detections"]
    assert each["id"] == ""
    assert xyz(each["results"][0]["pose"]["pose"]["position"]) == [0.0, 0.0, 0.0]
    assert variances(each["results"][0]) == [1e6] * 6
    assert of("detections", detections=[])["detections"] == ()


def test_depth_without_a_known_error_is_not_exact() -> None:
    message = of("detections", detections=[detection(depth_sigma_m=None)])
    assert variances(message["detections"][0]["results"][0]) == [1e6] * 6


def test_object_has_its_position_in_enu_with_covariance() -> None:
    covariance = np.diag([4.0, 9.0, 1.0, 1.0])
    covariance[0, 1] = covariance[1, 0] = 0.3
    found = object_in_frame(
        object_id=5,
        class_name="car",
        position_ned_m=[10.0, 20.0, -1.5],
        covariance=covariance.ravel().tolist(),
    )
    boxes = [detection(object_id=4, confidence=0.1), detection(object_id=5, confidence=0.7)]
    message = of("detections_3d", objects=[found], detections=boxes)
    assert message["header"]["frame_id"] == "drone1/map"
    (each,) = message["detections"]
    assert each["id"] == "5"
    (result,) = each["results"]
    assert result["hypothesis"] == {"class_id": "car", "score": 0.7}
    assert xyz(result["pose"]["pose"]["position"]) == [20.0, 10.0, 1.5]
    assert each["bbox"]["center"] == result["pose"]["pose"]
    rotated = ENU_FROM_NED[:2, :2] @ covariance[:2, :2] @ ENU_FROM_NED[:2, :2].T
    expected = np.diag([1e6] * 6)
    expected[:2, :2] = rotated
    np.testing.assert_array_equal(np.reshape(result["pose"]["covariance"], (6, 6)), expected)


@pytest.mark.parametrize("change", [{"occluded": True}, {"position_ned_m": None}])
def test_object_that_is_not_in_the_frame_or_not_located_is_left_out(change: dict[str, Any]) -> None:
    kept = object_in_frame(object_id=1)
    message = of("detections_3d", objects=[object_in_frame(object_id=2, **change), kept])
    assert [each["id"] for each in message["detections"]] == ["1"]


def test_labels_are_the_text() -> None:
    assert converted("labels", "Käfer, bus".encode()) == {"data": "Käfer, bus"}
    with pytest.raises(ValueError, match="labels"):
        converted("labels", b"\xff")


def test_images_have_the_same_pixels() -> None:
    compressed, image = of("image/compressed"), of("image")
    assert compressed["format"] == "jpeg"
    assert bytes(compressed["data"]) == JPEG
    assert (image["height"], image["width"], image["encoding"], image["step"]) == (48, 64, "bgr8", 192)
    pixels = np.frombuffer(image["data"], np.uint8).reshape(PIXELS.shape)
    np.testing.assert_array_equal(pixels, decode_image(JPEG))
    np.testing.assert_allclose(pixels[24, 10], (0, 0, 255), atol=12)
    assert image["header"] == compressed["header"]


def test_png_is_named() -> None:
    about = json.dumps(body_of(IMAGE)).encode()
    assert converted("image/compressed", b"\x89PNG\r\n", about)["format"] == "png"


def test_camera_info_is_that_of_the_bus() -> None:
    payload, _ = payload_of(CAMERA_INFO, distortion_model="equidistant", d=[1.0, 2.0, 3.0, 4.0])
    message, body = converted("camera_info", payload), json.loads(payload)
    names = ("height", "width", "distortion_model", "d", "k", "r", "p")
    assert equal({name: message[name] for name in names}, {name: body[name] for name in names})
    assert message["header"]["frame_id"] == "drone1/camera_optical"


def test_camera_info_of_an_image_has_its_stamp_and_size() -> None:
    """As image_proc needs it: its rays are those of the whole frame's pixels."""
    messages, topic = Messages("", abs), BY_NAME["camera_info"]
    k = [100.0, 0.0, 63.5, 0.0, 110.0, 47.5, 0.0, 0.0, 1.0]
    p = [90.0, 0.0, 63.5, -9.0, 0.0, 95.0, 47.5, 0.0, 0.0, 0.0, 1.0, 0.0]
    image = payload_of(IMAGE)
    assert messages.convert(topic, None, *image, IMAGE) is None  # its lens is not known yet
    lens = {"width": 128, "height": 96, "k": k, "p": p}
    assert messages.convert(topic, None, *payload_of(CAMERA_INFO, stamp_ns=CAPTURED_NS - 9, **lens))
    cdr = messages.convert(topic, None, *image, IMAGE)
    assert cdr is not None
    info = decode(topic.type_name, cdr)
    assert stamp_ns(info["header"]) == CAPTURED_NS
    assert (info["width"], info["height"]) == PIXELS.shape[1::-1]
    model = CameraModel(128, 96, 100.0, 110.0, 63.5, 47.5).scaled(64, 48)
    assert equal(info["k"], [model.fx, 0, model.cx, 0, model.fy, model.cy, 0, 0, 1])
    assert equal(info["p"], [45, 0, model.cx, -4.5, 0, 47.5, model.cy, 0, 0, 0, 1, 0])
    for after_s, sent in ((1, False), (3, True)):  # alone again once there are no images
        again = payload_of(CAMERA_INFO, stamp_ns=CAPTURED_NS + after_s * 10**9, **lens)
        assert (messages.convert(topic, None, *again) is not None) == sent


def test_points_have_places_and_colours() -> None:
    message = of("points")
    formats = {7: "<f4"}
    layout = np.dtype(
        {
            "names": [field["name"] for field in message["fields"]],
            "formats": [formats[field["datatype"]] for field in message["fields"]],
            "offsets": [field["offset"] for field in message["fields"]],
            "itemsize": message["point_step"],
        }
    )
    assert (message["height"], message["width"], message["row_step"]) == (1, 2, 32)
    points = np.frombuffer(message["data"], layout)
    np.testing.assert_array_equal(np.column_stack([points[name] for name in "xyz"]), POINTS.points)
    assert np.isfinite(points["rgb"]).all()
    colours = points["rgb"].view("<u4")
    np.testing.assert_array_equal(
        np.column_stack([colours >> 16, colours >> 8 & 255, colours & 255]), POINTS.colours
    )


@pytest.mark.parametrize(
    ("mount", "children"),
    [
        (CameraMount(0.1, 0.02, 0.05, 0.1, -0.4, 0.2), ["base_link", "cameras/down_optical"]),
        (CameraMount(0.1, yaw_rad=0.1, on_gimbal=True), ["base_link", "gimbal", "cameras/down_optical"]),
    ],
    ids=["fixed", "gimbal"],
)
def test_transforms_lead_from_the_camera_to_enu(mount: CameraMount, children: list[str]) -> None:
    gimbal = GimbalState(attitude_ns=CAPTURED_NS, attitude=quaternion_from_euler(0.0, -0.5, 1.1))
    history = StateHistory()
    history.add(replace(STATE, position_ns=CAPTURED_NS, gimbal=gimbal))
    body = transforms_message(7, CAPTURED_NS, mount, history, "v-1", "down")
    message = converted("/tf", json.dumps(body).encode(), camera="down")
    found = message["transforms"]
    names = ["map", *children]
    assert [each["header"]["frame_id"] for each in found] == [f"drone1/{name}" for name in names[:-1]]
    assert [each["child_frame_id"] for each in found] == [f"drone1/{name}" for name in names[1:]]
    ours = theirs = np.array([1.0, -2.0, 10.0])
    for each, transform in zip(reversed(body["transforms"]), reversed(found), strict=True):
        w, x, y, z = each["rotation_wxyz"]
        ours = matrix_from_quaternion((w, x, y, z)) @ ours + each["translation_m"]
        theirs = matrix(transform["transform"]["rotation"]) @ theirs + xyz(
            transform["transform"]["translation"]
        )
    np.testing.assert_allclose(theirs, ENU_FROM_NED @ ours, atol=1e-9)
    np.testing.assert_allclose(
        matrix(found[0]["transform"]["rotation"]),
        ENU_FROM_NED @ matrix_from_quaternion(STATE.attitude or (1, 0, 0, 0)) @ FLU_FROM_FRD,
        atol=1e-5,
    )


def test_pose_is_on_tf_where_no_camera_has_brought_one() -> None:
    messages, topic = Messages("drone1/", abs), BY_NAME["/tf"]

    def sent(position_ns: int) -> Any:
        body = vehicle_message(replace(STATE, position_ns=position_ns), position_ns + 40_000_000)
        cdr = messages.convert(topic, None, json.dumps(body).encode(), None, VEHICLE)
        return None if cdr is None else decode(topic.type_name, cdr)["transforms"][0]

    first = sent(CAPTURED_NS)
    assert (first["header"]["frame_id"], first["child_frame_id"]) == ("drone1/map", "drone1/base_link")
    assert stamp_ns(first["header"]) == CAPTURED_NS
    assert xyz(first["transform"]["translation"]) == [2.0, 1.0, 3.0]
    assert sent(CAPTURED_NS) is None  # each pose once
    assert sent(CAPTURED_NS + 10**8)
    history = StateHistory()
    history.add(replace(STATE, position_ns=CAPTURED_NS))
    frame = transforms_message(7, CAPTURED_NS, CameraMount(), history, "v-1")
    assert messages.convert(topic, None, json.dumps(frame).encode())
    assert [bool(sent(CAPTURED_NS + index * 5 * 10**8)) for index in (1, 2, 3)] == [False, True, True]
    assert sent(CAPTURED_NS + 10**8) is None


@given(UNIT)
def test_pose_is_enu_from_flu(wxyz: Sequence[float]) -> None:
    unit = np.array(wxyz) / math.hypot(*wxyz)
    body = body_of(VEHICLE, attitude_wxyz=unit.tolist(), position_ned_m=[1.0, 2.0, -3.0], position_valid=True)
    message = converted("pose", json.dumps(body).encode())
    assert message["header"]["frame_id"] == "drone1/map"
    assert xyz(message["pose"]["position"]) == [2.0, 1.0, 3.0]
    w, x, y, z = unit.tolist()
    expected = ENU_FROM_NED @ matrix_from_quaternion((w, x, y, z)) @ FLU_FROM_FRD
    np.testing.assert_allclose(matrix(message["pose"]["orientation"]), expected, atol=1e-9)


@pytest.mark.parametrize(("heading_deg", "forward"), [(0, (0, 1, 0)), (90, (1, 0, 0)), (180, (0, -1, 0))])
def test_heading_turns_the_nose_in_enu(heading_deg: float, forward: tuple[int, int, int]) -> None:
    attitude = quaternion_from_euler(0.0, 0.0, math.radians(heading_deg))
    body = vehicle_message(replace(STATE, attitude=attitude), CAPTURED_NS)
    message = converted("pose", json.dumps(body).encode())
    np.testing.assert_allclose(matrix(message["pose"]["orientation"])[:, 0], forward, atol=1e-4)
    np.testing.assert_allclose(matrix(message["pose"]["orientation"])[:, 2], (0, 0, 1), atol=1e-4)
    assert stamp_ns(message["header"]) == CAPTURED_NS - 40_000_000 + OFFSET_NS


def test_fix_and_battery() -> None:
    body = {**vehicle_message(STATE, CAPTURED_NS), "battery_fraction": 0.5}
    fix = converted("fix", json.dumps(body).encode())
    assert (fix["latitude"], fix["longitude"], fix["altitude"]) == (47.4, 8.5, 500.0)
    assert (fix["status"], fix["position_covariance_type"]) == ({"status": -2, "service": 0}, 0)
    assert fix["header"]["frame_id"] == "drone1/base_link"
    assert stamp_ns(fix["header"]) == CAPTURED_NS - 300_000_000 + OFFSET_NS
    battery = converted("battery", json.dumps(body).encode())
    assert (battery["percentage"], battery["present"]) == (0.5, True)
    assert all(math.isnan(battery[name]) for name in ("voltage", "current", "charge", "capacity"))


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("fix", {"latitude_deg": None}),
        ("fix", {"longitude_deg": None}),
        ("fix", {"global_age_s": None}),
        ("pose", {"position_ned_m": None}),
        ("pose", {"attitude_wxyz": None}),
        ("pose", {"position_valid": False}),
        ("battery", {"battery_fraction": None}),
    ],
)
def test_what_is_not_known_is_not_sent(name: str, changes: dict[str, Any]) -> None:
    assert of(name, **changes) is None


@pytest.mark.parametrize(("valid", "status"), [(True, 0), (False, -1), (None, -2)])
def test_fix_says_whether_the_estimate_is_usable(valid: bool | None, status: int) -> None:
    fix = of("fix", altitude_amsl_m=None, position_valid=valid)
    assert math.isnan(fix["altitude"])
    assert fix["status"] == {"status": status, "service": 0}


def test_fix_of_an_older_recording_has_the_age_of_the_position() -> None:
    body = vehicle_message(STATE, CAPTURED_NS)
    older = {name: value for name, value in body.items() if name != "global_age_s"}
    fix = converted("fix", json.dumps(older).encode())
    assert stamp_ns(fix["header"]) == CAPTURED_NS - 40_000_000 + OFFSET_NS


def test_stamp_without_an_age_is_that_of_the_message() -> None:
    message = of("pose", position_age_s=None, stamp_ns=CAPTURED_NS)
    assert stamp_ns(message["header"]) == CAPTURED_NS + OFFSET_NS


@pytest.mark.parametrize(
    ("state", "level"), [("ready", 0), ("finished", 0), ("starting", 1), ("missing", 1), ("failed", 2)]
)
def test_diagnostics_have_a_level_for_each_part(state: str, level: int) -> None:
    template = body_of(STATUS)
    part = {**template["parts"][0], "name": "camera down", "state": state, "reason": "no frames"}
    cameras = {"down": {**template["perception"], "rate_hz": 29.5, "model": None}}
    message = of("/diagnostics", healthy=False, unhealthy=["a", "b"], parts=[part], cameras=cameras)
    assert message["header"]["frame_id"] == ""
    service, guidance, down = message["status"]
    assert (service["name"], service["level"], service["message"]) == ("drone1/companion: service", 2, "a; b")
    assert guidance["name"] == "drone1/companion: guidance"
    assert (down["name"], down["level"], down["message"]) == (
        "drone1/companion: camera down", level, "no frames",
    )  # fmt: skip
    values = {each["key"]: each["value"] for each in down["values"]}
    assert (values["rate_hz"], values["state"]) == ("29.5", state)
    assert "model" not in values
    assert down["hardware_id"] == template["vehicle"]["name"]


@pytest.mark.parametrize("topic", OUTPUT_TOPICS, ids=lambda topic: topic.name)
@pytest.mark.parametrize("broken", [b"", b"{", b"[]", b"{}", b"null", b'{"captured_ns": "now"}', b"\xff"])
def test_what_is_not_of_its_topic_is_refused(topic: RosTopic, broken: bytes) -> None:
    payload, attachment = payload_for(topic)
    if topic.source == LABELS:
        payload = b"\xff"
    elif topic.source in LARGE_TOPICS:
        attachment = broken
    else:
        payload = broken
    with pytest.raises(ValueError, match=topic.source.name) as caught:
        MESSAGES.convert(topic, None, payload, attachment)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("topic", "changes"),
    [
        (DETECTIONS, {"captured_ns": 2**63}),
        (TRANSFORMS, {"captured_ns": -(2**63)}),
        (VEHICLE, {"stamp_ns": 2**62}),
    ],
)
def test_stamp_outside_of_ros_is_refused(topic: Topic, changes: dict[str, Any]) -> None:
    body = {**body_of(topic), **changes}
    ros = next(each for each in OUTPUT_TOPICS if each.source == topic)
    with pytest.raises(ValueError, match=topic.name):
        MESSAGES.convert(ros, None, json.dumps(body).encode())


@pytest.mark.parametrize("payload", [b"", b"\xff\xd8", JPEG[:300]])
def test_damaged_image_is_refused(payload: bytes) -> None:
    about = json.dumps(body_of(IMAGE)).encode()
    with pytest.raises(ValueError, match="image"):
        converted("image", payload, about)


def test_cloud_of_another_length_is_refused() -> None:
    about = json.dumps(body_of(CLOUD, points=3)).encode()
    with pytest.raises(ValueError, match="32 bytes"):
        converted("points", POINTS.packed(), about)
