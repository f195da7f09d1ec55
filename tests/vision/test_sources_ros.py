"""`ros://`: addresses of ROS 2 topics, and the frames that the node writes for them."""

from __future__ import annotations

import secrets
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vision.camera_model import CameraCalibration, CameraModel
from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter, segment_path
from vision.sources import SourceError, SourceSettings, SourceUnavailableError, open_source
from vision.sources.opening import check_address
from vision.sources.ros import RosAddress, parse_ros_address
from vision.sources.source import CameraChangedError

QUICK = SourceSettings(open_timeout_s=20.0, read_timeout_s=0.3, retry_min_s=0.02, retry_max_s=0.05)
CAMERA = RosAddress("/camera/image_raw", "/camera/depth/image_raw", "/camera/camera_info")


@pytest.mark.parametrize(
    ("uri", "address"),
    [
        ("ros://camera/image_raw", RosAddress("/camera/image_raw")),
        ("ros:///camera/image_raw", RosAddress("/camera/image_raw")),
        ("ros://image", RosAddress("/image")),
        ("ros://camera/image_raw?depth=/camera/depth/image_raw&info=/camera/camera_info", CAMERA),
        ("ros://camera/image_raw?info=camera/camera_info&depth=camera/depth/image_raw", CAMERA),
        ("ros://camera/image_raw?info=%2Fcamera%2Fcamera_info", replace(CAMERA, depth=None)),
    ],
)
def test_address_names_topics(uri: str, address: RosAddress) -> None:
    assert parse_ros_address(uri) == address


@pytest.mark.parametrize(
    "uri",
    [
        "ros://",
        "ros:///",
        "ros:////camera",
        "ros://camera/",
        "ros://camera//image",
        "ros://1camera/image",
        "ros://camera/image-raw",
        "ros://~/image",
        "ros://{node}/image",
        "ros://camera/bild_ü",
        "ros://camera/image raw",
        "ros://" + "a" * 247,
        "ros://camera/image?depth",
        "ros://camera/image?depth=",
        "ros://camera/image?depth=a&depth=b",
        "ros://camera/image?range=/camera/range",
        "ros://camera/image?depth=/camera/image",
        "ros://camera/image?depth=/d&info=/d",
        "ros://camera/image?info=/../x",
    ],
)
@pytest.mark.parametrize("check", [check_address, open_source])
def test_wrong_address_is_a_one_line_error(uri: str, check: object) -> None:
    assert callable(check)
    with pytest.raises(SourceError) as refused:
        check(uri, SourceSettings())
    assert not isinstance(refused.value, SourceUnavailableError)
    assert "\n" not in str(refused.value)


TOPICS = st.from_regex(r"\A(/[A-Za-z_][A-Za-z0-9_]{0,80}){1,3}\Z")


@given(TOPICS, st.none() | TOPICS, st.none() | TOPICS)
def test_segment_is_a_file_name_for_any_topics(image: str, depth: str | None, info: str | None) -> None:
    assume(image not in (depth, info) and (depth is None or depth != info))
    address = RosAddress(image, depth, info)
    assert segment_path(address.segment).name == address.segment
    assert parse_ros_address(str(address)) == address


def test_segment_differs_for_images_and_lens_alone() -> None:
    addresses = [
        CAMERA,
        replace(CAMERA, info=None),
        RosAddress("/camera/image_raw", info="/other/camera_info"),
        RosAddress("/camera/depth/image_raw"),
        RosAddress("/camera_image_raw"),
        RosAddress("/" + "a" * 200),
        RosAddress("/" + "a" * 201),
    ]
    assert len({address.segment for address in addresses}) == len(addresses)
    assert replace(CAMERA, depth=None).segment == CAMERA.segment


def test_missing_node_is_named_with_the_remedy() -> None:
    uri = f"ros://test_{secrets.token_hex(6)}/image_raw"
    with pytest.raises(SourceUnavailableError, match=f"^{uri}: .*`companion ros2 node` running"):
        open_source(uri, SourceSettings(open_timeout_s=0.2, retry_min_s=0.05))


@pytest.mark.realtime
def test_frames_of_the_node_have_stamp_and_lens() -> None:
    uri = f"ros://test_{secrets.token_hex(6)}/image_raw?info=/camera_info"
    lens = CameraCalibration(CameraModel.from_horizontal_fov(6, 4, 1.2))
    other = CameraCalibration(CameraModel.from_horizontal_fov(6, 4, 1.3))
    name = parse_ros_address(uri).segment
    captured_ns = time.monotonic_ns() - 20_000_000
    written = Frame(np.full((4, 6, 3), 50, np.uint8), captured_ns, 1)
    with SharedFrameWriter(name, 6, 4, depth=False, calibration=lens) as writer:
        writer.write(written)
        with open_source(uri, QUICK) as source:
            assert (source.uri, source.live, source.calibration) == (uri, True, lens)
            frame = source.read(20.0)
            assert frame is not None
            assert frame.captured_ns == captured_ns
            assert np.array_equal(frame.image, written.image)
            writer.close()
            with SharedFrameWriter(name, 6, 4, depth=False, calibration=other) as second:
                second.write(replace(written, captured_ns=time.monotonic_ns(), sequence=2))
                with pytest.raises(CameraChangedError):
                    source.read(20.0)


@pytest.mark.realtime
@pytest.mark.parametrize("own_setting", [False, True])
def test_depth_is_that_of_its_own_topic(own_setting: bool) -> None:
    name = f"test_{secrets.token_hex(6)}"
    address = RosAddress(f"/{name}/image", f"/{name}/depth", f"/{name}/camera_info")
    lens = CameraCalibration(CameraModel.from_horizontal_fov(6, 4, 1.2))
    stamp_ns = time.monotonic_ns()
    image, depth_m = np.full((4, 6, 3), 50, np.uint8), np.full((4, 6), 2.5, np.float32)
    uri, settings = str(address), replace(QUICK, loop=True)
    if own_setting:
        uri, settings = str(replace(address, depth=None)), replace(QUICK, depth=f"ros://{name}/depth")
    with (
        SharedFrameWriter(address.segment, 6, 4, depth=False, calibration=lens) as writer,
        SharedFrameWriter(RosAddress(f"/{name}/depth").segment, 6, 4, depth=True) as depth_writer,
    ):
        writer.write(Frame(image, stamp_ns, 1))
        depth_writer.write(Frame(np.zeros_like(image), stamp_ns, 1, depth_m))
        with open_source(uri, settings) as source:
            frame = source.read(20.0)
            assert source.calibration == lens
    assert frame is not None
    assert frame.captured_ns == stamp_ns
    assert frame.depth_m is not None
    assert (frame.depth_m == 2.5).all()
    assert (frame.image == 50).all()


def test_two_depth_sources_are_refused() -> None:
    with pytest.raises(SourceError, match=r"source\.depth"):
        open_source("ros://image?depth=/depth", SourceSettings(depth="ros://other"))
