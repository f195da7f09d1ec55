"""Depth cameras: RealSense, `realsense://SERIAL`, and OAK, `oak://ID`; the first one found without a name.

Depth is registered to the colour image by the maker's library, `pyrealsense2` or `depthai` 3, which is
imported when such a source is opened. Both bring their lens, not their mount.

Not tested with a real camera: the tests use stand-in modules of the same interface, and the calls were
checked against the libraries (pyrealsense2 2.59, depthai 3.12) as far as they run without a camera.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import time
from datetime import timedelta
from functools import cache
from typing import Any

import numpy as np

from vision.camera_model import CameraCalibration, CameraModel
from vision.extras import install_command
from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.depth_images import to_metres
from vision.sources.source import SourceError, SourceSettings

logger = logging.getLogger(__name__)

DEFAULT_SIZE, DEFAULT_RATE_HZ = (640, 480), 30.0
_OAK_STEREO_SIZE = (640, 400)
_MILLIMETRE = 0.001
_OLDEST_STAMP_NS = 1_000_000_000  # an older stamp is from another clock


def load_module(name: str, uri: str) -> Any:
    """Import a maker's library.

    Raises:
        SourceError: it is not installed, or does not load.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise SourceError(f"{uri}: needs {name}: {install_command(name)} ({error})") from error


def depth_camera_addresses() -> list[str]:
    """Addresses of the depth cameras that are connected, by the libraries that are installed."""
    found: list[str] = []
    for name, scheme, listed in (
        ("pyrealsense2", "realsense", _realsense_serials),
        ("depthai", "oak", _oak_identifiers),
    ):
        if importlib.util.find_spec(name) is None:
            continue
        try:
            found += [f"{scheme}://{each}" for each in listed(importlib.import_module(name))]
        except (ImportError, RuntimeError) as error:
            logger.warning("%s finds no cameras: %s", name, error)
    return found


def _realsense_serials(module: Any) -> list[str]:
    return [str(each.get_info(module.camera_info.serial_number)) for each in module.context().query_devices()]


def _oak_identifiers(module: Any) -> list[str]:
    return [str(each.getDeviceId()) for each in module.Device.getAllAvailableDevices()]


def _size(settings: SourceSettings) -> tuple[int, int]:
    return settings.width or DEFAULT_SIZE[0], settings.height or DEFAULT_SIZE[1]


def _stamp_ns(stamp_ns: float) -> int:
    """A stamp of CLOCK_MONOTONIC if it is plausible, else the time of arrival."""
    now_ns = time.monotonic_ns()
    return round(stamp_ns) if 0 <= now_ns - stamp_ns < _OLDEST_STAMP_NS else now_ns


@cache  # once, not for each reopening
def _warn_ignored_distortion(coefficients: tuple[float, ...]) -> None:
    logger.warning(
        "the camera's distortion is inverse Brown-Conrady, %s, and is ignored: its focal lengths and centre "
        "are used. If positions near the image's edge matter, calibrate the lens (companion calibrate)",
        coefficients,
    )


class RealsenseCapture(Capture):
    """Colour and depth of a RealSense camera.

    Args:
        serial: its serial number; empty: the first one found.
        module: `pyrealsense2`.

    Raises:
        CaptureError: no such camera, or it has no such size and rate.
    """

    def __init__(self, serial: str, settings: SourceSettings, module: Any) -> None:
        self._rs = rs = module
        width, height = _size(settings)
        rate_hz = round(settings.rate_hz or DEFAULT_RATE_HZ)
        config = rs.config()
        if serial:
            config.enable_device(serial)
        config.enable_stream(rs.stream.color, width, height, rs.format.bgr8, rate_hz)
        config.enable_stream(rs.stream.depth, rs.format.z16, rate_hz)
        self._pipeline = rs.pipeline()
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise CaptureError(f"{error} ({width}x{height} at {rate_hz} Hz)") from error
        self._align = rs.align(rs.stream.color)
        self._scale_m = profile.get_device().first_depth_sensor().get_depth_scale()
        self._number: int | None = None
        lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        self.calibration = self._calibration(lens)

    def _calibration(self, lens: Any) -> CameraCalibration | None:
        distortion = tuple(float(value) for value in lens.coeffs)
        if any(distortion) and lens.model != self._rs.distortion.brown_conrady:
            if lens.model != self._rs.distortion.inverse_brown_conrady:
                logger.warning("the camera's lens has the distortion %s, which is not supported", lens.model)
                return None
            _warn_ignored_distortion(distortion)
            distortion = ()
        return CameraCalibration(
            CameraModel(
                lens.width,
                lens.height,
                lens.fx,
                lens.fy,
                lens.ppx,
                lens.ppy,
                distortion if any(distortion) else (),
            )
        )

    def read(self, timeout_s: float) -> RawFrame | None:
        try:
            arrived, frames = self._pipeline.try_wait_for_frames(max(1, round(timeout_s * 1000)))
            if not arrived:
                return None
            aligned = self._align.process(frames)
        except RuntimeError as error:
            raise CaptureError(str(error)) from error
        colour, depth = aligned.get_color_frame(), aligned.get_depth_frame()
        if not colour or not depth:
            return None
        image = np.array(colour.get_data(), np.uint8)  # copies: the library reuses its buffers
        depth_m = to_metres(np.asarray(depth.get_data()), self._scale_m)
        number = int(colour.get_frame_number())
        skipped = 0 if self._number is None else max(number - self._number - 1, 0)
        self._number = number
        stamp_ns = float("-inf")
        if colour.get_frame_timestamp_domain() != self._rs.timestamp_domain.hardware_clock:
            # Milliseconds of the system's clock.
            stamp_ns = time.monotonic_ns() - (time.time() * 1e3 - colour.get_timestamp()) * 1e6
        return RawFrame(image, _stamp_ns(stamp_ns), depth_m, skipped=skipped)

    def close(self) -> None:
        self._pipeline.stop()


class OakCapture(Capture):
    """Colour, without distortion, and stereo depth of an OAK camera.

    Args:
        identifier: its device id or address; empty: the first one found.
        module: `depthai`, version 3.

    Raises:
        CaptureError: no such camera, or it does not start or deliver.
    """

    def __init__(self, identifier: str, settings: SourceSettings, module: Any) -> None:
        dai = module
        # Milliseconds of the library's search for a camera, 10 s by default, which cannot be interrupted.
        os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", f"{settings.open_timeout_s * 500:.0f}")
        try:
            self._device = dai.Device(dai.DeviceInfo(identifier)) if identifier else dai.Device()
        except RuntimeError as error:
            raise CaptureError(str(error)) from error
        try:
            self._pipeline = dai.Pipeline(self._device)
            self._queue = self._build(dai, settings)
            self._pipeline.start()
            # The first pair has the lens, which must be known before it is delivered.
            self._first: Any = self._queue.get(timedelta(seconds=settings.open_timeout_s))
            if self._first is None:
                raise CaptureError("it delivers no images with depth")
        except RuntimeError as error:
            self._device.close()
            raise CaptureError(str(error)) from error
        except BaseException:
            self._device.close()
            raise
        colour = self._first["colour"]
        (fx, _, cx), (_, fy, cy), _ = colour.getTransformation().getIntrinsicMatrix()
        width, height = colour.getWidth(), colour.getHeight()
        self.calibration = CameraCalibration(CameraModel(width, height, fx, fy, cx, cy))
        self._number: int | None = None

    def _build(self, dai: Any, settings: SourceSettings) -> Any:
        """The pipeline: colour, stereo depth registered to it, both synchronized. Returns its queue."""
        pipeline, socket = self._pipeline, dai.CameraBoardSocket
        rate_hz = settings.rate_hz or DEFAULT_RATE_HZ
        camera = pipeline.create(dai.node.Camera).build(socket.CAM_A)
        colour = camera.requestOutput(
            _size(settings), dai.ImgFrame.Type.BGR888i, fps=rate_hz, enableUndistortion=True
        )
        left, right = (
            pipeline.create(dai.node.Camera).build(place).requestOutput(_OAK_STEREO_SIZE, fps=rate_hz)
            for place in (socket.CAM_B, socket.CAM_C)
        )
        stereo = pipeline.create(dai.node.StereoDepth).build(left, right)
        depth = stereo.depth
        if self._device.getPlatform() == dai.Platform.RVC4:
            align = pipeline.create(dai.node.ImageAlign)
            stereo.depth.link(align.input)
            colour.link(align.inputAlignTo)
            depth = align.outputAligned
        else:
            colour.link(stereo.inputAlignTo)
        sync = pipeline.create(dai.node.Sync)
        sync.setSyncThreshold(timedelta(seconds=0.5 / rate_hz))
        colour.link(sync.inputs["colour"])
        depth.link(sync.inputs["depth"])
        return sync.out.createOutputQueue(maxSize=2, blocking=False)

    def read(self, timeout_s: float) -> RawFrame | None:
        group, self._first = self._first, None
        try:
            group = group or self._queue.get(timedelta(seconds=timeout_s))
        except RuntimeError as error:
            raise CaptureError(str(error)) from error
        except Exception as error:  # the queue's own, which derives from Exception, when the device is gone
            raise CaptureError(f"{type(error).__name__}: {error}") from error
        if group is None:
            return None
        colour = group["colour"]
        number = int(colour.getSequenceNum())
        skipped = 0 if self._number is None else max(number - self._number - 1, 0)
        self._number = number
        depth_m = to_metres(np.asarray(group["depth"].getFrame()), _MILLIMETRE)
        image = np.ascontiguousarray(colour.getCvFrame(), np.uint8)
        # Of the host's steady clock, to which the library synchronizes the camera's.
        captured_ns = _stamp_ns(colour.getTimestamp().total_seconds() * 1e9)
        return RawFrame(image, captured_ns, depth_m, skipped=skipped)

    def close(self) -> None:
        self._pipeline.stop()
        self._device.close()
