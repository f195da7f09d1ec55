"""Images of ROS 2 topics → frames in shared memory, which `vision.sources` opens as `ros://…`.

Depth is as in REP 118, `camera_info` as in `sensor_msgs`: K and D belong to the raw image, P to a topic
whose name has a word that begins with `image_rect`, as `image_rect/compressed`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.ros2 import cdr
from companion.ros2.gateway import Losses
from vision.calibration_files.lens_names import distortion_name
from vision.camera_model import CameraCalibration, CameraModel, scaled_to_frames
from vision.image_file import decode, frame_pixels, stated_size
from vision.shared_frame import SharedFrameWriter
from vision.sources.depth_images import FLOAT_SCALE_M, INTEGER_SCALE_M, decode_depth, to_metres
from vision.sources.ros import SCHEME, RosAddress, parse_ros_address
from vision.sources.source import SourceError

IMAGE, COMPRESSED, CAMERA_INFO = (
    f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo")
)

# Encoding (sensor_msgs/image_encodings.hpp) → bytes of a pixel, and OpenCV's conversion to BGR.
_COLOUR: dict[str, tuple[int, int | None]] = {
    "bgr8": (3, None),
    "8UC3": (3, None),  # of cv_bridge, without a stated order
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "mono8": (1, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, cv2.COLOR_GRAY2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2BGR_YUY2),
}
for _order in ("RGGB", "BGGR", "GBRG", "GRBG"):
    _COLOUR[f"bayer_{_order.lower()}8"] = 1, getattr(cv2, f"COLOR_Bayer{_order}2BGR")
_DEEP = {"mono16": "u2", "16UC1": "u2", "32FC1": "f4"}
_DEPTH = ("16UC1", "32FC1")
_COMPRESSED_DEPTH_HEADER = 12  # bytes, compression_common.h: only 32FC1 needs it

# A larger image is refused before it is decoded: a PNG of 1 MB can need gigabytes.
_MOST_PIXELS = 1 << 25
_OLDEST_NS = 60_000_000_000  # an older stamp is of another clock; a newer one may be of a slow network
_AHEAD_NS = 50_000_000  # drivers' clocks and the steps of /clock run ahead so far


class RosCamera:
    """The messages of one topic of images → frames in shared memory.

    `captured_ns` of a frame is the stamp in its header. Where that cannot be (0, after the arrival, before
    the previous one, older than a minute) it is the arrival. Such stamps are counted, and so is every message
    that makes no frame. Depth has black images.

    Args:
        address: its topic, and that of its lens; without depth, which is a camera of its own.
        report: called with a line, as by `Losses`.
        on_frame: called with `captured_ns` and the header's stamp, nanoseconds, before readers see a frame
            whose stamp is used: messages about the frame can then have the stamp of its image.

    Attributes:
        topics: what to subscribe to → the type that image_transport's names give it.
        problems: counts by kind: `message`, `encoding`, `repeated`, `stamp`, `depth`, `info` (none yet),
            `lens`, `memory`.
    """

    def __init__(
        self, address: RosAddress, report: Callable[[str], None], on_frame: Callable[[int, int], None]
    ) -> None:
        compressed = address.image.endswith(("/compressed", "/compressedDepth"))
        self.topics = {address.image: COMPRESSED if compressed else IMAGE}
        if address.info is not None:
            self.topics[address.info] = CAMERA_INFO
        self.address = address
        self._losses, self._on_frame = Losses(report), on_frame
        self.problems = self._losses.counts
        self._writer: SharedFrameWriter | None = None
        self._lens: CameraModel | None = None
        self._info = b""
        self._stamp_ns = self._captured_ns = self._received = 0
        self._closed = False
        self._lock = Lock()

    def on_serialized(
        self,
        topic: str,
        type_name: str,
        payload: bytes | memoryview,
        received_ns: int,
        ros_now_ns: int,
        _age_ns: int = 0,
    ) -> None:
        """Process a message; those of other topics are ignored.

        Args:
            payload: CDR, used during the call only.
            received_ns: CLOCK_MONOTONIC of its arrival. ros_now_ns: the ROS time at that moment.
        """
        with self._lock:
            if self._closed or topic not in self.topics:
                return
            try:
                if topic == self.address.info:
                    self._on_info(payload)
                else:
                    self._on_image(cdr.decode(type_name, payload), received_ns, ros_now_ns)
            except (ValueError, SourceError, cv2.error) as error:
                kind = "encoding" if isinstance(error, _UnknownEncodingError) else "message"
                self._problem(kind, f"{type_name} is not used: {error}")

    def close(self) -> None:
        """Remove the shared memory, from any thread. Later messages are ignored."""
        with self._lock:
            self._closed = True
            self._remove()

    def _remove(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _on_image(self, message: Mapping[str, Any], received_ns: int, ros_now_ns: int) -> None:
        self._received += 1  # readers count a gap as lost frames
        capture = self._capture(message["header"]["stamp"], received_ns, ros_now_ns)
        if capture is None:
            return
        captured_ns, stamp_ns = capture
        pixels, conversion, is_depth = (_compressed if "format" in message else _raw)(message)
        scale_m = INTEGER_SCALE_M if pixels.dtype.kind == "u" else FLOAT_SCALE_M
        depth_m = to_metres(pixels, scale_m) if is_depth else None
        writer = self._writer_for((pixels.shape[1], pixels.shape[0]), is_depth)
        if writer is None:
            return
        self._captured_ns = max(captured_ns, self._captured_ns + 1)  # trackers need it to increase
        if stamp_ns is not None:
            self._on_frame(self._captured_ns, stamp_ns)
        with writer.slot(self._received, self._captured_ns) as (image, depth):
            if depth is not None:
                image[:], depth[:] = 0, depth_m
            elif conversion is None:
                image[:] = pixels
            else:
                cv2.cvtColor(pixels, conversion, dst=image)

    def _capture(
        self, stamp: Mapping[str, int], received_ns: int, ros_now_ns: int
    ) -> tuple[int, int | None] | None:
        """The capture by the header's stamp, and that; or the arrival. None: it was received before."""
        stamp_ns = stamp["sec"] * 1_000_000_000 + stamp["nanosec"]
        before_ns, self._stamp_ns = self._stamp_ns, stamp_ns
        age_ns = ros_now_ns - stamp_ns
        if stamp_ns == 0:
            why = "is 0"
        elif stamp_ns == before_ns:
            self._problem("repeated", "a message with the stamp of the previous one is left out")
            return None
        elif age_ns < -_AHEAD_NS:
            why = f"is {-age_ns / 1e9:.3f} s in the future: do both computers have the same time?"
        elif age_ns > _OLDEST_NS:
            why = f"is {age_ns / 1e9:.0f} s old: of another clock? (use_sim_time)"
        elif stamp_ns < before_ns:
            why = f"is {(before_ns - stamp_ns) / 1e9:.3f} s before the previous one"
        else:
            return received_ns - max(age_ns, 0), stamp_ns
        self._problem("stamp", f"the stamp of a message {why}; its arrival is used")
        return received_ns, None

    def _on_info(self, payload: bytes | memoryview) -> None:
        content = bytes(payload[12:])  # behind the stamp
        if content == self._info:
            return
        self._info, lens = content, None
        try:
            rectified = "/image_rect" in self.address.image
            lens = lens_of(cdr.decode(CAMERA_INFO, payload), rectified=rectified)
        except ValueError as error:
            self._problem("lens", f"no lens is used: {self.address.info}: {error}")
        if lens != self._lens:
            self._lens = lens
            self._remove()

    def _writer_for(self, size: tuple[int, int], depth: bool) -> SharedFrameWriter | None:
        """The writer of such frames; None: there can be none now."""
        writer = self._writer
        if writer is not None and (writer.width, writer.height, writer.depth) == (*size, depth):
            return writer
        if self.address.info is not None and not self._info:
            self._problem("info", f"the images wait for {self.address.info}: no message yet")
            return None
        self._remove()
        calibration = None
        try:
            if self._lens is not None:
                calibration = CameraCalibration(scaled_to_frames(self._lens, *size))
        except ValueError as error:
            self._problem("lens", f"no lens is used: {self.address.info}: {error}")
        try:
            self._writer = SharedFrameWriter(self.address.segment, *size, depth, calibration=calibration)
        except (OSError, ValueError) as error:
            self._problem("memory", f"the images cannot be shared: {error}")
        return self._writer

    def _problem(self, kind: str, text: str) -> None:
        self._losses.add(kind, f"{self.address.image}: {text}")


def ros_cameras(
    uris: Iterable[str], report: Callable[[str], None], on_frame: Callable[[int, int], None]
) -> tuple[RosCamera, ...]:
    """Return the cameras of the `ros://` addresses among these. Raises SourceError for a wrong one."""
    addresses: dict[RosAddress, None] = {}
    for address in [parse_ros_address(uri) for uri in uris if uri.startswith(SCHEME)]:
        addresses[replace(address, depth=None)] = None
        if address.depth is not None:
            addresses[RosAddress(address.depth)] = None
    return tuple(RosCamera(address, report, on_frame) for address in addresses)


class _UnknownEncodingError(ValueError):
    """An encoding or compression that is not read."""


# (height, width, …) pixels as OpenCV's conversion takes them, None: BGR or depth; whether they are depth.
_Image = tuple[NDArray[Any], int | None, bool]


def _raw(message: Mapping[str, Any]) -> _Image:
    """The pixels of an Image, in the message's memory. Raises ValueError: unknown, or of another size."""
    encoding, step, data = message["encoding"], message["step"], message["data"]
    width, height = message["width"], message["height"]
    pixel_bytes, conversion = _COLOUR.get(encoding, (0, None))
    item = np.dtype(np.uint8)
    if encoding in _DEEP:
        item = np.dtype((">" if message["is_bigendian"] else "<") + _DEEP[encoding])
        pixel_bytes = item.itemsize
    if not pixel_bytes:
        known = ", ".join((*_COLOUR, *_DEEP))
        raise _UnknownEncodingError(f"the encoding {encoding[:40]!r} is not read, only {known}")
    _check_size(width, height)
    channels = () if pixel_bytes == item.itemsize else (pixel_bytes,)
    least = (width + width % 2 if channels == (2,) else width) * pixel_bytes  # 4:2:2 has pairs of pixels
    if width == 0 or height == 0 or step < least or len(data) != step * height:
        size = f"{width}x{height} pixels of {encoding} in {height} rows of {step} bytes"
        raise ValueError(f"{size} do not fit the {len(data)} bytes of data")
    strides = (step, pixel_bytes, 1)[: 2 + len(channels)]
    pixels: NDArray[Any] = np.ndarray((height, width, *channels), item, data, strides=strides)
    if encoding == "mono16":
        pixels = frame_pixels(pixels.astype(np.uint16), "mono16")
    return pixels, conversion, encoding in _DEPTH


def _compressed(message: Mapping[str, Any]) -> _Image:
    """The image of compressed_image_transport (JPEG, PNG, TIFF) or compressed_depth_image_transport."""
    kind, data = message["format"], bytes(message["data"])
    encoding, _, method = (part.strip() for part in kind.partition(";"))
    if method.startswith("compressedDepth"):
        if encoding != "16UC1" or method not in ("compressedDepth", "compressedDepth png"):
            raise _UnknownEncodingError(f"the format {kind[:60]!r} is not read: 16UC1 as PNG is")
        data = data[_COMPRESSED_DEPTH_HEADER:]
    if (size := stated_size(data)) is None:
        raise ValueError("its image is no JPEG, PNG or TIFF with a size in its header")
    _check_size(*size)
    if encoding not in _DEPTH:
        return decode(data).pixels, None, False
    image = decode_depth(Path("its image"), data)
    if image is None:
        raise ValueError("its depth image is damaged")
    return image, None, True


def _check_size(width: int, height: int) -> None:
    if width * height > _MOST_PIXELS:
        raise ValueError(
            f"its image has {width}x{height} pixels, more than {_MOST_PIXELS}; publish it smaller"
        )


def lens_of(message: Mapping[str, Any], rectified: bool = False) -> CameraModel:
    """Return the lens of a `sensor_msgs/CameraInfo` for the images of its region and binning.

    Args:
        message: as `cdr.decode` gives it. rectified: of the rectified images, which have no distortion.

    Raises:
        ValueError: the camera is not calibrated, this is no lens, or the distortion model is not known.
    """
    roi, (fx, cx, fy, cy) = message["roi"], (message["k"][index] for index in (0, 2, 4, 5))
    if fx == 0.0:
        raise ValueError("the camera is not calibrated")
    model, coefficients = distortion_name(message["distortion_model"] or "none", message["d"])
    if rectified:
        (fx, cx, fy, cy), model, coefficients = (message["p"][i] for i in (0, 2, 5, 6)), "plumb_bob", ()
    width, height = roi["width"] or message["width"], roi["height"] or message["height"]
    cx, cy = cx - roi["x_offset"], cy - roi["y_offset"]
    lens = CameraModel(width, height, fx, fy, cx, cy, coefficients, model)
    return lens.scaled(width // max(message["binning_x"], 1), height // max(message["binning_y"], 1))
