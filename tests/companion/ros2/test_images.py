"""Messages of ROS 2 cameras as frames in shared memory."""

from __future__ import annotations

import secrets
import struct
import time
import zlib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from companion.ros2 import cdr
from companion.ros2.gateway import Losses
from companion.ros2.images import CAMERA_INFO, COMPRESSED, IMAGE, RosCamera, lens_of, ros_cameras
from vision.frame import Frame
from vision.shared_frame import SharedFrameReader, SharedFrameWriter, segment_path
from vision.sources.ros import RosAddress

WIDTH, HEIGHT = 8, 6
ROS_NS, ARRIVAL_NS = 1_700_000_000_000_000_000, 5_000_000_000_000
STEP_NS = 33_333_333
BGR = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
DEPTH_MM = np.arange(1000, 1000 + WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
K = (400.0, 0.0, 4.0, 0.0, 401.0, 3.0, 0.0, 0.0, 1.0)


def header(stamp_ns: int) -> dict[str, Any]:
    return {
        "stamp": {"sec": stamp_ns // 1_000_000_000, "nanosec": stamp_ns % 1_000_000_000},
        "frame_id": "cam",
    }


def image(
    pixels: NDArray[Any], encoding: str, stamp_ns: int = ROS_NS, padding: int = 0, **fields: Any
) -> bytes:
    """An Image whose rows end with some more bytes; `fields` are set as they are."""
    rows = pixels.reshape(len(pixels), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    values = {
        "header": header(stamp_ns),
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "step": rows.shape[1],
        "data": rows.tobytes(),
    }
    return cdr.encode(IMAGE, values | fields)


def compressed(kind: str, data: bytes, stamp_ns: int = ROS_NS) -> bytes:
    return cdr.encode(COMPRESSED, {"header": header(stamp_ns), "format": kind, "data": data})


def info(**fields: Any) -> bytes:
    values = {
        "header": header(ROS_NS),
        "width": WIDTH,
        "height": HEIGHT,
        "distortion_model": "plumb_bob",
        "d": (0.1, -0.2, 0.0, 0.0, 0.0),
        "k": K,
    }
    return cdr.encode(CAMERA_INFO, values | fields)


def png(pixels: NDArray[Any]) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


class Camera:
    """A `RosCamera` with topics of its own, the stamps of its frames, and the newest that a reader sees."""

    def __init__(self, info: bool = False, topic: str = "image_raw") -> None:
        name = f"/test_{secrets.token_hex(6)}"
        self.address = RosAddress(f"{name}/{topic}", info=f"{name}/camera_info" if info else None)
        self.reports: list[str] = []
        self.stamps: dict[int, int] = {}
        self.ros = RosCamera(self.address, self.reports.append, self.stamps.__setitem__)
        self.reader: SharedFrameReader | None = None

    def send(
        self,
        payload: bytes,
        kind: str = IMAGE,
        topic: str | None = None,
        at_ns: int = 0,
        latency_ns: int = 20_000_000,
    ) -> None:
        """A message that arrives so long after ROS_NS and the latency; its memory is used again then."""
        buffer = bytearray(payload)
        self.ros.on_serialized(
            topic or self.address.image,
            kind,
            memoryview(buffer),
            ARRIVAL_NS + latency_ns + at_ns,
            ROS_NS + latency_ns + at_ns,
        )
        buffer[:] = bytes(len(buffer))

    def frame(self) -> Frame | None:
        if self.reader is None and segment_path(self.address.segment).exists():
            self.reader = SharedFrameReader(self.address.segment)
        return None if self.reader is None else self.reader.latest()

    def seen(self) -> Frame:
        frame = self.frame()
        assert frame is not None
        return frame


@pytest.fixture
def camera() -> Iterator[Camera]:
    camera = Camera()
    yield camera
    camera.ros.close()


@pytest.fixture
def known() -> Iterator[Camera]:
    camera = Camera(info=True)
    yield camera
    camera.ros.close()


GRAY = np.ascontiguousarray(BGR[:, :, 0])
YUV = BGR[:, :, :2]
COLOURS: dict[str, tuple[NDArray[Any], NDArray[Any]]] = {
    "bgr8": (BGR, BGR),
    "8UC3": (BGR, BGR),
    "rgb8": (BGR[:, :, ::-1], BGR),
    "bgra8": (np.dstack([BGR, GRAY]), BGR),
    "rgba8": (np.dstack([BGR[:, :, ::-1], GRAY]), BGR),
    "mono8": (GRAY, np.dstack([GRAY] * 3)),
    "8UC1": (GRAY, np.dstack([GRAY] * 3)),
    "yuv422": (YUV, cv2.cvtColor(YUV.copy(), cv2.COLOR_YUV2BGR_UYVY)),
    "uyvy": (YUV, cv2.cvtColor(YUV.copy(), cv2.COLOR_YUV2BGR_UYVY)),
    "yuv422_yuy2": (YUV, cv2.cvtColor(YUV.copy(), cv2.COLOR_YUV2BGR_YUY2)),
    "yuyv": (YUV, cv2.cvtColor(YUV.copy(), cv2.COLOR_YUV2BGR_YUY2)),
    "mono16": (GRAY.astype(np.uint16) * 256, np.dstack([GRAY] * 3)),
}


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", COLOURS)
def test_encoding_becomes_bgr(camera: Camera, encoding: str, padding: int) -> None:
    pixels, expected = COLOURS[encoding]
    camera.send(image(np.ascontiguousarray(pixels), encoding, padding=padding))
    frame = camera.seen()
    assert np.array_equal(frame.image, expected)
    assert frame.depth_m is None
    assert not camera.ros.problems


@pytest.mark.parametrize(
    ("encoding", "first_row", "second_row"),
    [("rggb", "RG", "GB"), ("bggr", "BG", "GR"), ("gbrg", "GB", "RG"), ("grbg", "GR", "BG")],
)
def test_bayer_pattern_keeps_the_colours(
    camera: Camera, encoding: str, first_row: str, second_row: str
) -> None:
    values = {"B": 10, "G": 100, "R": 200}
    cell = np.array([[values[one] for one in row] for row in (first_row, second_row)], np.uint8)
    camera.send(image(np.tile(cell, (8, 8)), f"bayer_{encoding}8"))
    assert camera.seen().image[4:-4, 4:-4].reshape(-1, 3).tolist() == [[10, 100, 200]] * 64


def big_endian(pixels: NDArray[Any]) -> bytes:
    """An Image written by hand as CDR and pixels of a big-endian computer."""
    data = pixels.astype(pixels.dtype.newbyteorder(">")).tobytes()
    stamp = struct.pack(">iI", *divmod(ROS_NS, 1_000_000_000))
    size = struct.pack(">II", *pixels.shape)
    encoding = struct.pack(">I", 6) + b"16UC1\0" + b"\x01"  # is_bigendian
    body = stamp + struct.pack(">I", 4) + b"cam\0" + size + encoding
    body += bytes(-len(body) % 4) + struct.pack(">I", 2 * pixels.shape[1])
    return b"\0\0\0\0" + body + struct.pack(">I", len(data)) + data


def test_big_endian_depth_is_read(camera: Camera) -> None:
    camera.send(big_endian(DEPTH_MM))
    assert np.allclose(camera.seen().depth_m, DEPTH_MM / 1000)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["bgr8; jpeg compressed bgr8", "jpeg", "rgb8; png compressed bgr8", "png"])
def test_compressed_image_is_decoded_by_its_content(camera: Camera, kind: str) -> None:
    data = cv2.imencode(".jpg", BGR)[1].tobytes() if "jpeg" in kind else png(BGR)
    camera.send(compressed(kind, data), COMPRESSED)
    expected: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(camera.seen().image, expected)


@pytest.mark.parametrize("latency_ms", [0, 3, 250, 10_000])
def test_stamp_becomes_the_time_of_capture(camera: Camera, latency_ms: int) -> None:
    camera.send(image(BGR, "bgr8"), latency_ns=latency_ms * 1_000_000)
    assert camera.seen().captured_ns == ARRIVAL_NS


@pytest.mark.parametrize(
    "stamp_ns",
    [0, ROS_NS + 3_000_000_000, ROS_NS - 100_000_000_000, 1_500_000_000, -5_000_000_000],
    ids=["0", "future", "old", "of another clock", "negative"],
)
def test_impossible_stamp_is_replaced_by_the_arrival(camera: Camera, stamp_ns: int) -> None:
    for index in range(3):
        at_ns = index * STEP_NS
        camera.send(image(BGR, "bgr8", stamp_ns + bool(stamp_ns) * at_ns), at_ns=at_ns)
        assert camera.seen().captured_ns == ARRIVAL_NS + 20_000_000 + at_ns
    assert camera.ros.problems == {"stamp": 3}
    assert len(camera.reports) == 1


def test_stamp_is_reported_with_the_capture_that_is_written(camera: Camera) -> None:
    expected = {}
    # The stamps of the first two are ahead of an arrival at the same time: 1 ns is added to the second one.
    for stamp_ns in (ROS_NS + 30_000_000, ROS_NS + 40_000_000):
        camera.send(image(BGR, "bgr8", stamp_ns))
        expected[camera.seen().captured_ns] = stamp_ns
    camera.send(image(BGR, "bgr8", ROS_NS + STEP_NS + 10_000_000), at_ns=STEP_NS)
    expected[camera.seen().captured_ns] = ROS_NS + STEP_NS + 10_000_000
    assert len(expected) == 3
    assert camera.stamps == expected


def test_stamp_that_is_replaced_is_not_reported(camera: Camera) -> None:
    camera.send(image(BGR, "bgr8", 0))
    camera.send(image(BGR, "nv21"), at_ns=STEP_NS)
    assert camera.stamps == {}


def test_stamp_is_reported_before_the_frame_is_seen(camera: Camera) -> None:
    seen = []
    camera.ros = RosCamera(camera.address, camera.reports.append, lambda *_: seen.append(camera.frame()))
    try:
        camera.send(image(BGR, "bgr8"))
    finally:
        camera.ros.close()
    assert seen == [None]


def test_stamp_a_little_ahead_is_the_arrival_uncounted(camera: Camera) -> None:
    camera.send(image(BGR, "bgr8", ROS_NS + 40_000_000))
    assert camera.seen().captured_ns == ARRIVAL_NS + 20_000_000
    assert not camera.ros.problems


def test_stamp_that_jumps_back_is_replaced_once(camera: Camera) -> None:
    for index, jump_ns in enumerate((0, 0, 2_000_000_000, 0)):
        at_ns = index * STEP_NS
        camera.send(image(BGR, "bgr8", ROS_NS + at_ns - jump_ns), at_ns=at_ns)
    assert camera.ros.problems == {"stamp": 1}
    assert camera.seen().captured_ns == ARRIVAL_NS + 3 * STEP_NS


def test_time_of_capture_increases_for_any_stamps(camera: Camera) -> None:
    before_ns = 0
    rng = np.random.default_rng(1)
    for index in range(200):
        at_ns = index * STEP_NS
        stamp_ns = ROS_NS + at_ns + int(rng.integers(-5_000_000_000, 5_000_000_000))
        camera.send(image(BGR, "bgr8", stamp_ns), at_ns=at_ns)
        captured_ns = camera.seen().captured_ns
        assert before_ns < captured_ns <= ARRIVAL_NS + 20_000_000 + at_ns
        before_ns = captured_ns


def test_message_with_the_stamp_of_the_previous_one_is_left_out(camera: Camera) -> None:
    camera.send(image(BGR, "bgr8"))
    first = camera.seen()
    camera.send(image(BGR, "bgr8"), at_ns=STEP_NS)
    assert camera.seen().sequence == first.sequence
    assert camera.ros.problems == {"repeated": 1}


def wrong(pixels: NDArray[Any] = BGR, encoding: str = "bgr8", **fields: Any) -> bytes:
    return image(pixels, encoding, ROS_NS + STEP_NS, **fields)


@pytest.mark.parametrize(
    ("payload", "kind"),
    [
        pytest.param(wrong(step=20), "message", id="step"),
        pytest.param(wrong(height=HEIGHT + 1), "message", id="too few bytes"),
        pytest.param(wrong(height=HEIGHT - 1), "message", id="too many bytes"),
        pytest.param(wrong(width=0, height=0, step=0, data=b""), "message", id="empty"),
        pytest.param(wrong(width=2**31, height=2**31, step=2**32 - 1), "message", id="huge"),
        pytest.param(wrong()[:-1], "message", id="truncated"),
        pytest.param(wrong()[:9], "message", id="header truncated"),
        pytest.param(b"", "message", id="nothing"),
        pytest.param(b"\0\x07\0\0" + wrong()[4:], "message", id="unknown encapsulation"),
        pytest.param(wrong(YUV[:, :7].copy(), "yuyv"), "message", id="odd width"),
        pytest.param(wrong(encoding="nv21"), "encoding", id="encoding"),
        pytest.param(wrong(encoding=""), "encoding", id="no encoding"),
        pytest.param(wrong(encoding="x" * 10_000), "encoding", id="long encoding"),
    ],
)
def test_unusable_image_is_counted_and_the_next_one_comes(camera: Camera, payload: bytes, kind: str) -> None:
    camera.send(image(BGR, "bgr8"))
    first = camera.seen()
    camera.send(payload, at_ns=STEP_NS)
    assert camera.seen().sequence == first.sequence
    assert camera.ros.problems == {kind: 1}
    (text,) = camera.reports
    assert "\n" not in text
    assert len(text) < 500
    camera.send(image(BGR, "bgr8", ROS_NS + 2 * STEP_NS), at_ns=2 * STEP_NS)
    assert camera.seen().sequence > first.sequence


VALID = {
    IMAGE: image(DEPTH_MM, "16UC1"),
    COMPRESSED: compressed("16UC1; compressedDepth png", bytes(12) + png(DEPTH_MM)),
    CAMERA_INFO: info(roi={"width": 4, "height": 4}, binning_x=2),
}


@given(st.sampled_from(list(VALID)), st.data())
def test_damaged_message_never_ends_the_camera(kind: str, data: st.DataObject) -> None:
    payload = bytearray(VALID[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(payload) - 1))
        payload[at] = data.draw(st.integers(0, 255))
    camera = Camera(info=True)
    topic = camera.address.info if kind == CAMERA_INFO else camera.address.image
    try:
        camera.send(VALID[CAMERA_INFO], CAMERA_INFO, camera.address.info)
        camera.send(bytes(payload[: data.draw(st.integers(0, len(payload)))]), kind, topic)
        camera.send(bytes(payload), kind, topic, at_ns=STEP_NS)
        camera.send(image(BGR, "bgr8", ROS_NS + 1), at_ns=2 * STEP_NS)
        assert camera.frame() is not None
    finally:
        camera.ros.close()


def test_damaged_jpeg_is_counted(camera: Camera) -> None:
    data = cv2.imencode(".jpg", np.zeros((480, 640, 3), np.uint8))[1].tobytes()
    camera.send(compressed("jpeg", data[: len(data) // 2]), COMPRESSED)
    assert camera.frame() is None
    assert camera.ros.problems == {"message": 1}


def bomb() -> bytes:
    """A PNG of 16000x16000 pixels, 31 kB."""
    header = struct.pack(">IIBBBBB", 16000, 16000, 1, 0, 0, 0, 0)
    rows = zlib.compress(bytes(2001 * 16000))
    parts = ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b""))
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@pytest.mark.parametrize(
    ("payload", "kind"),
    [
        pytest.param(compressed("png", bomb()), COMPRESSED, id="png"),
        pytest.param(compressed("16UC1; compressedDepth png", bytes(12) + bomb()), COMPRESSED, id="depth"),
        pytest.param(compressed("jpeg", cv2.imencode(".webp", BGR)[1].tobytes()), COMPRESSED, id="no size"),
        pytest.param(image(np.zeros((1, 2**25 + 1), np.uint8), "mono8"), IMAGE, id="raw"),
    ],
)
def test_image_that_is_too_large_is_not_decoded(
    camera: Camera, payload: bytes, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("imdecode", "cvtColor"):
        monkeypatch.setattr(cv2, name, lambda *_, **__: pytest.fail("decoded"))
    camera.send(payload, kind)
    assert camera.frame() is None
    assert camera.ros.problems == {"message": 1}
    assert len(camera.reports) == 1
    camera.send(image(BGR, "bgr8", ROS_NS + STEP_NS), at_ns=STEP_NS)
    assert camera.seen().width == WIDTH


def test_new_size_gets_a_new_shared_memory(camera: Camera) -> None:
    camera.send(image(BGR, "bgr8"))
    assert camera.seen().width == WIDTH
    larger = np.full((20, 30, 3), 9, np.uint8)
    camera.send(image(larger, "bgr8", ROS_NS + STEP_NS), at_ns=STEP_NS)
    frame = camera.seen()
    assert (frame.width, frame.height, int(frame.image.max())) == (30, 20, 9)


def test_depth_of_floats_has_holes(camera: Camera) -> None:
    metres = (DEPTH_MM / 1000).astype(np.float32)
    metres[0, :4] = (0.0, np.nan, np.inf, -1.0)
    camera.send(image(metres, "32FC1"))
    depth_m = camera.seen().depth_m
    assert depth_m is not None
    assert np.isnan(depth_m[0, :4]).all()
    assert np.allclose(depth_m[1:], metres[1:])


def test_floats_of_millimetres_are_refused(camera: Camera) -> None:
    camera.send(image(DEPTH_MM.astype(np.float32), "32FC1"))
    assert camera.frame() is None
    assert camera.ros.problems == {"message": 1}


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        ("16UC1; png compressed ", png(DEPTH_MM)),
        ("16UC1; compressedDepth", bytes(12) + png(DEPTH_MM)),
        ("16UC1; compressedDepth png", bytes(12) + png(DEPTH_MM)),
    ],
)
def test_compressed_depth_is_read(camera: Camera, kind: str, data: bytes) -> None:
    camera.send(compressed(kind, data), COMPRESSED)
    assert np.allclose(camera.seen().depth_m, DEPTH_MM / 1000)  # type: ignore[arg-type]
    assert not camera.ros.problems


@pytest.mark.parametrize("kind", ["16UC1; compressedDepth rvl", "32FC1; compressedDepth png"])
def test_compressed_depth_of_another_method_is_named(camera: Camera, kind: str) -> None:
    camera.send(compressed(kind, bytes(100)), COMPRESSED)
    assert camera.ros.problems == {"encoding": 1}
    assert kind in camera.reports[0]


def test_depth_alone_has_a_black_image(camera: Camera) -> None:
    camera.send(image(DEPTH_MM, "16UC1"))
    frame = camera.seen()
    assert not frame.image.any()
    assert np.allclose(frame.depth_m, DEPTH_MM / 1000)  # type: ignore[arg-type]


def test_images_wait_for_their_camera_info(known: Camera) -> None:
    known.send(image(BGR, "bgr8"))
    assert known.frame() is None
    assert known.ros.problems == {"info": 1}
    known.send(info(), CAMERA_INFO, known.address.info)
    known.send(image(BGR, "bgr8", ROS_NS + STEP_NS), at_ns=STEP_NS)
    known.seen()
    assert known.reader is not None
    assert known.reader.calibration is not None
    model = known.reader.calibration.model
    assert (model.fx, model.cx, model.fy, model.cy) == (400.0, 4.0, 401.0, 3.0)
    assert model.distortion == (0.1, -0.2, 0.0, 0.0, 0.0)


def test_lens_is_scaled_to_the_images(known: Camera) -> None:
    known.send(info(width=2 * WIDTH, height=2 * HEIGHT), CAMERA_INFO, known.address.info)
    known.send(image(BGR, "bgr8"))
    known.seen()
    assert known.reader is not None
    assert known.reader.calibration is not None
    assert known.reader.calibration.model.fx == 200.0


@pytest.mark.parametrize(
    "fields",
    [
        {"k": (0.0,) * 9},
        {"k": (float("nan"), *K[1:])},
        {"distortion_model": "omnidirectional"},
        {"d": (0.1, 0.2)},
        {"height": HEIGHT * 3},
        {"width": 0},
    ],
    ids=["uncalibrated", "nan", "model", "coefficients", "aspect", "size"],
)
def test_unusable_camera_info_is_named_and_images_come(known: Camera, fields: dict[str, Any]) -> None:
    for _ in range(3):
        known.send(info(**fields), CAMERA_INFO, known.address.info)
    known.send(image(BGR, "bgr8"))
    known.seen()
    assert known.reader is not None
    assert known.reader.calibration is None
    assert known.ros.problems == {"lens": 1}


def test_long_distortion_model_is_cut(known: Camera) -> None:
    known.send(info(distortion_model="x\n" * 10_000), CAMERA_INFO, known.address.info)
    (text,) = known.reports
    assert "\n" not in text
    assert len(text) < 400


def test_truncated_camera_info_is_named(known: Camera) -> None:
    known.send(info()[:60], CAMERA_INFO, known.address.info)
    assert known.ros.problems == {"lens": 1}


def test_changed_lens_gets_a_new_shared_memory(known: Camera) -> None:
    known.send(info(), CAMERA_INFO, known.address.info)
    known.send(image(BGR, "bgr8"))
    first = segment_path(known.address.segment).stat().st_ino
    known.send(info(header=header(ROS_NS + STEP_NS)), CAMERA_INFO, known.address.info)
    known.send(image(BGR, "bgr8", ROS_NS + STEP_NS), at_ns=STEP_NS)
    assert segment_path(known.address.segment).stat().st_ino == first, "only the stamp differs"
    zoomed = (800.0, *K[1:4], 802.0, *K[5:])
    known.send(info(k=zoomed), CAMERA_INFO, known.address.info)
    known.send(image(BGR, "bgr8", ROS_NS + 2 * STEP_NS), at_ns=2 * STEP_NS)
    with SharedFrameReader(known.address.segment) as reader:
        assert reader.calibration is not None
        assert reader.calibration.model.fx == 800.0


@pytest.mark.parametrize(
    ("name", "coefficients", "model", "expected"),
    [
        ("plumb_bob", (0.1, 0.2, 0.3, 0.4, 0.5), "plumb_bob", (0.1, 0.2, 0.3, 0.4, 0.5)),
        ("plumb_bob", (), "plumb_bob", ()),
        ("", (), "plumb_bob", ()),
        ("rational_polynomial", (0.1,) * 8, "rational_polynomial", (0.1,) * 8),
        ("equidistant", (0.1, 0.2, 0.3, 0.4), "equidistant", (0.1, 0.2, 0.3, 0.4)),
        ("plumb_bob", (0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0), "plumb_bob", (0.1, 0.2, 0.3, 0.4, 0.5)),
    ],
)
def test_distortion_models_of_ros(
    name: str, coefficients: tuple[float, ...], model: str, expected: tuple[float, ...]
) -> None:
    lens = lens_of(cdr.decode(CAMERA_INFO, info(distortion_model=name, d=coefficients)))
    assert (lens.distortion_model, lens.distortion) == (model, expected)


def test_lens_of_a_region_and_binning() -> None:
    region = {"x_offset": 2, "y_offset": 1, "width": 4, "height": 4}
    lens = lens_of(cdr.decode(CAMERA_INFO, info(roi=region, binning_x=2, binning_y=2)))
    assert (lens.width, lens.height, lens.fx, lens.cx, lens.cy) == (2, 2, 200.0, 0.75, 0.75)


def test_lens_of_rectified_images_is_that_of_p() -> None:
    p = (300.0, 0.0, 3.5, 0.0, 0.0, 301.0, 2.5, 0.0, 0.0, 0.0, 1.0, 0.0)
    lens = lens_of(cdr.decode(CAMERA_INFO, info(p=p)), rectified=True)
    assert (lens.fx, lens.cx, lens.fy, lens.cy, lens.distortion) == (300.0, 3.5, 301.0, 2.5, ())


@pytest.mark.parametrize(
    ("topic", "fx"),
    [
        ("image_rect", 300.0),
        ("image_rect/compressed", 300.0),
        ("image_rect_color/compressed", 300.0),
        ("image_raw/compressed", 400.0),
        ("not_image_rect", 400.0),
    ],
)
def test_topic_of_rectified_images_has_the_lens_of_p(topic: str, fx: float) -> None:
    p = (300.0, 0.0, 3.5, 0.0, 0.0, 301.0, 2.5, 0.0, 0.0, 0.0, 1.0, 0.0)
    camera = Camera(info=True, topic=topic)
    try:
        camera.send(info(p=p), CAMERA_INFO, camera.address.info)
        raw = "compressed" not in topic
        camera.send(image(BGR, "bgr8") if raw else compressed("png", png(BGR)), IMAGE if raw else COMPRESSED)
        camera.seen()
        assert camera.reader is not None
        assert camera.reader.calibration is not None
        assert camera.reader.calibration.model.fx == fx
    finally:
        camera.ros.close()


def test_second_node_of_one_topic_is_named(camera: Camera) -> None:
    with SharedFrameWriter(camera.address.segment, 4, 4, depth=False):
        for index in range(3):
            camera.send(image(BGR, "bgr8", ROS_NS + index * STEP_NS), at_ns=index * STEP_NS)
    assert camera.ros.problems == {"memory": 3}
    assert len(camera.reports) == 1
    camera.send(image(BGR, "bgr8", ROS_NS + 2_000_000_000), at_ns=2_000_000_000)
    assert camera.seen().width == WIDTH


def test_topics_have_the_types_of_image_transport() -> None:
    uris = [
        "/dev/video0",
        "ros://cam/image_raw/compressed?depth=/cam/depth/compressedDepth&info=/cam/camera_info",
        "ros://cam/image_raw?depth=/cam/depth/compressedDepth",
        "ros://cam/image_raw",
    ]
    assert [camera.topics for camera in ros_cameras(uris, print, print)] == [
        {"/cam/image_raw/compressed": COMPRESSED, "/cam/camera_info": CAMERA_INFO},
        {"/cam/depth/compressedDepth": COMPRESSED},
        {"/cam/image_raw": IMAGE},
    ]


def test_message_of_another_topic_is_ignored(camera: Camera) -> None:
    camera.send(image(BGR, "bgr8"), topic="/other")
    camera.send(b"", topic="/other")
    assert camera.frame() is None
    assert not camera.ros.problems


def test_lost_messages_are_a_gap_in_the_sequence(camera: Camera) -> None:
    camera.send(image(BGR, "bgr8"))
    first = camera.seen()
    camera.send(image(BGR, "nv21", ROS_NS + STEP_NS), at_ns=STEP_NS)
    camera.send(image(BGR, "bgr8", ROS_NS + 2 * STEP_NS), at_ns=2 * STEP_NS)
    assert camera.seen().sequence == first.sequence + 2


def test_shared_memory_is_removed_at_the_end(camera: Camera) -> None:
    camera.send(image(BGR, "bgr8"))
    assert segment_path(camera.address.segment).exists()
    camera.ros.close()
    camera.send(image(BGR, "bgr8", ROS_NS + STEP_NS), at_ns=STEP_NS)
    assert not segment_path(camera.address.segment).exists()


def test_counts_are_said_each_minute_with_more_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, lines = 0.0, list[str]()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    losses = Losses(lines.append)
    for second in range(130):
        now_s = float(second)
        if second < 70:
            losses.add("encoding", "nv21")
        losses.add("stamp", "is 0")
    assert losses.counts == {"encoding": 70, "stamp": 130}
    assert lines == ["nv21", "is 0", "nv21 (59 more before)", *["is 0 (59 more before)"] * 2]
