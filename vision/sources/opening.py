"""Opens a source by its address."""

from __future__ import annotations

import contextlib
import difflib
import os
import re
import stat
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

from vision.calibration_files.camera_info import read_registration
from vision.home import expanded
from vision.image_file import is_image
from vision.redaction import HIDDEN, without_password
from vision.registry import shown
from vision.sources.camera import CameraCapture, camera_device, check_camera
from vision.sources.capture import Capture, LoopingCapture
from vision.sources.csi import CsiCapture, check_csi_program, csi_settings, parse_csi_number
from vision.sources.depth_cameras import OakCapture, RealsenseCapture, load_module
from vision.sources.depth_images import DEPTH_SUFFIXES, is_depth_image, read_depth
from vision.sources.files import ImagesCapture, VideoFileCapture, images_in, partners
from vision.sources.latest import LatestSource
from vision.sources.network import UdpStream, check_user_info, open_http, open_rtsp
from vision.sources.opencv import quiet_opencv
from vision.sources.paired import TOLERANCE_S, DepthImages, depth_error, paired_source
from vision.sources.pipe import Fifo, PipeCapture, check_pipe_settings
from vision.sources.registry import SOURCES, OpenSource, source
from vision.sources.ros import SCHEME, RosAddress, parse_ros_address
from vision.sources.sequential import SequentialSource
from vision.sources.shared import SharedFrameCapture, check_name
from vision.sources.source import (
    RAW_PIXEL_FORMATS,
    Source,
    SourceError,
    SourceSettings,
    SourceUnavailableError,
)

_IMAGE_RATE_HZ = 10.0  # of images used as a camera without rate_hz
# Their images are already taken when they arrive. A plug-in's scheme decides itself.
_WITHOUT_EXPOSURE = ("file", "rtsp", "rtsps", "http", "https", "udp", "shm", "ros", "realsense", "oak")
# Suffixes of names that may be a device's, a FIFO's or a mount's, which come by themselves.
_OF_PIPES = ("", ".fifo", ".pipe")
_NETWORK = ("rtsp", "rtsps", "http", "https")
# `admin:pw@camera/1` and `rtsp:/admin:pw@camera/1`: taken for a file, its error would show the password.
_WITHOUT_SLASHES = re.compile(r"(?:[A-Za-z][A-Za-z0-9+.-]*:/?)?[^/\s:@]*:[^\s]*@[^\s@]+", re.ASCII)
_WITHOUT_DEPTH = ("csi", "rtsp", "rtsps", "http", "https", "udp")


def open_source(uri: str, settings: SourceSettings = SourceSettings()) -> Source:  # noqa: B008 - frozen
    """Open a source of frames and wait for the first frame.

    | address | source | frames |
    |---|---|---|
    | `street.mp4`, `file:///data/street.mp4` | a video file | every one |
    | `photos/` | a folder of images, in natural order | every one |
    | `photo.jpg` | one image | one |
    | `-` | standard input: raw, YUV4MPEG2 or MJPEG | the newest; every one from a file or with `every_frame`
    | | `/run/camera.fifo` | a FIFO with the same | the newest; every one with `every_frame` |
    | `/dev/video0`, `0`, `/dev/v4l/by-id/…` | a camera | the newest |
    | `csi://0` | a CSI camera of a Raspberry Pi or Jetson | the newest |
    | `realsense://SERIAL`, `oak://ID` | a depth camera | the newest, with depth |
    | `rtsp://camera/stream` | RTSP | the newest |
    | `http://camera/video.mjpg` | Motion JPEG over HTTP, or what FFmpeg reads | the newest |
    | `udp://:5600`, `udp://239.1.2.3:5600` | MPEG-TS | the newest |
    | `udp://:5600?format=rtp-h264` | RTP: `rtp-h264`, `rtp-h265` or `rtp-jpeg` | the newest |
    | `shm://NAME` | shared memory of this host (`vision.shared_frame`), with depth | the newest |
    | `ros://camera/image_raw`, `…?depth=TOPIC&info=TOPIC` | a ROS 2 topic, with depth | the newest |

    Plug-ins register other schemes with `vision.sources.registry.source`.

    Args:
        uri: the address.
        settings: see `SourceSettings`.

    Raises:
        SourceError: it cannot be opened, or delivered no frame within `open_timeout_s`; one line with the
            reason.

    >>> import tempfile
    >>> import cv2, numpy as np
    >>> from vision import open_source
    >>> folder = tempfile.TemporaryDirectory()
    >>> cv2.imwrite(f"{folder.name}/photo.png", np.zeros((120, 160, 3), np.uint8))
    True
    >>> with open_source(f"{folder.name}/photo.png") as source:
    ...     source.live, next(iter(source)).width
    (False, 160)
    """
    quiet_opencv()
    if settings.depth is not None:
        return _open_with_depth(uri, settings.depth, settings)
    device = camera_device(uri)
    scheme = uri.partition("://")[0] if "://" in uri else ""
    name = "standard input" if uri == "-" else without_password(uri)
    if settings.as_depth:
        if device is not None or scheme in _WITHOUT_DEPTH:
            raise SourceError(
                f"{name}: delivers colour; source.depth is a file, folder, pipe of gray16 or shared memory"
            )
        settings = replace(settings, pixel_format="gray16")  # of pipes; files have their own
    if device is None and (not scheme or scheme in _WITHOUT_EXPOSURE):
        _refuse_exposure(name, settings)
    if uri == "-":
        return _open_standard_input(settings)
    if device is not None:
        check_camera(device, settings)
        return LatestSource(str(device), lambda: CameraCapture(device, settings), settings)
    if not scheme:
        _refuse_without_slashes(uri)
        return _open_path(expanded(uri), settings)
    opener = _opener(scheme, name)
    if scheme in _NETWORK:
        check_user_info(uri)
    opened = opener(uri, settings)
    if not isinstance(opened, Source):
        with contextlib.suppress(Exception):  # a plug-in's own class, or nothing to close
            opened.close()
        raise SourceError(f"{name}: the plug-in of {scheme}:// must return a Source, got {shown(opened)}")
    return opened


def check_address(uri: str, settings: SourceSettings) -> None:
    """Check the address of a source without opening it: its scheme, or that there is such a file or folder.

    Of shared memory and networks there is nothing more to check.

    Raises:
        SourceUnavailableError: as `check_there`.
        SourceError: no such scheme, file or folder, or not readable by this user.
    """
    check_there(uri)
    scheme = uri.partition("://")[0] if "://" in uri else ""
    if uri == "-" and sys.stdin is None:  # as Python shows a closed descriptor
        raise SourceError("standard input is closed: expected a pipe or a file, such as `ffmpeg … | …`")
    if uri == "-" or camera_device(uri) is not None:
        return
    if scheme in ("", "file"):
        path = Path(_rest(uri)) if scheme else expanded(uri)
        if not os.access(path, os.R_OK):
            raise SourceError(f"{path}: no permission to read it")
        return
    _opener(scheme, without_password(uri))
    if scheme in _NETWORK:
        check_user_info(uri)
    if scheme == "csi":
        parse_csi_number(uri), csi_settings(uri, settings)
        check_csi_program(uri)
    elif scheme == "shm":
        check_name(_rest(uri))
    elif scheme == "ros":
        parse_ros_address(uri)


def _opener(scheme: str, name: str) -> OpenSource:
    if (opener := SOURCES.get(scheme)) is None:
        raise SourceError(
            f"{name}: unknown scheme {scheme}://; known: {SOURCES.known()}, cameras "
            "(/dev/video0), files, folders, FIFOs and - for standard input. Schemes of a plug-in are known "
            "once its module is loaded (plugins.modules, --plugins-modules)"
        )
    return opener


def _open_with_depth(uri: str, depth_uri: str, settings: SourceSettings) -> Source:
    if uri == depth_uri == "-":
        raise SourceError("standard input cannot be both source.uri and source.depth")
    if uri.startswith(SCHEME) and parse_ros_address(uri).depth is not None:
        raise SourceError(f"{uri}: has the depth of its address: remove source.depth")
    if settings.loop:
        raise SourceError("source.loop cannot repeat two sources in step: remove it, or source.depth")
    registration = None
    if settings.depth_calibration_file is not None:
        try:
            registration = read_registration(settings.depth_calibration_file, settings.orientation)
        except ValueError as error:
            raise SourceError(str(error)) from error
    depth_images = DepthImages()
    # Recordings are read frame by frame, so that their images pair; the pair is played in real time.
    each = replace(settings, depth=None, depth_calibration_file=None, realtime=False, on_frame=None)
    of_depth = replace(each, as_depth=True, exposure_us=None, gain=None, name=None, on_frame=depth_images.add)
    colour, depth = open_two(uri, depth_uri, each, of_depth)
    tolerance_s = TOLERANCE_S
    if _folder(uri) is not None and _folder(depth_uri) is not None:
        # Their times are multiples of the interval: an image pairs with its partner alone.
        tolerance_s = 0.25 / _image_rate_hz(settings)
    return paired_source(
        colour, depth, depth_images, settings, tolerance_s=tolerance_s, registration=registration
    )


def open_two(
    uri: str, second_uri: str, settings: SourceSettings, second_settings: SourceSettings
) -> tuple[Source, Source]:
    """Open two sources at the same time; the images of two folders are paired by name, see `partners`.

    Raises:
        SourceError: one of them cannot be opened; the other one is closed.
    """
    folder, second_folder = _folder(uri), _folder(second_uri)

    def open_second() -> Source:
        if folder is None or second_folder is None:
            return open_source(second_uri, second_settings)
        rate_hz, images = _image_rate_hz(second_settings), images_in(folder)
        if second_settings.as_depth:
            paths = partners(images, images_in(second_folder, DEPTH_SUFFIXES))
            capture = partial(ImagesCapture, paths, rate_hz, read_depth)
        else:
            paths = partners(images, images_in(second_folder))
            capture = partial(ImagesCapture, paths, rate_hz)
        return SequentialSource(str(second_folder), capture, second_settings)

    # At the same time: one writer may wait until both its pipes are opened.
    with ThreadPoolExecutor(1, "second source") as executor:
        opening = executor.submit(open_second)
        try:
            first = open_source(uri, settings)
        except BaseException:
            with contextlib.suppress(SourceError):
                opening.result().close()
            raise
        try:
            return first, opening.result()
        except SourceError as error:
            first.close()
            if second_settings.as_depth:
                raise depth_error(error, without_password(second_uri)) from error
            raise
        except BaseException:
            first.close()
            raise


def _refuse_exposure(name: str, settings: SourceSettings) -> None:
    for key in ("exposure_us", "gain"):
        if getattr(settings, key) is not None:
            raise SourceError(
                f"{name}: source.{key} is for cameras (/dev/video0, csi://0); remove it, and set it in the "
                f"program that makes these images"
            )


@source("file", "a file or folder")
def _open_file_address(uri: str, settings: SourceSettings) -> Source:
    return _open_path(Path(_rest(uri)), settings)


@source("rtsp", "RTSP")
@source("rtsps", "RTSP over TLS")
def _open_rtsp(uri: str, settings: SourceSettings) -> Source:
    name = without_password(uri)
    return LatestSource(name, lambda: open_rtsp(uri, settings), settings, advice="is the camera on?")


@source("http", "Motion JPEG, or what FFmpeg reads")
@source("https", "the same over TLS")
def _open_http(uri: str, settings: SourceSettings) -> Source:
    # FFmpeg may read faster than real time over HTTP: a recording, or the first segments of HLS.
    return LatestSource(
        without_password(uri),
        lambda: open_http(uri, settings),
        settings,
        paced=True,
        advice="is the server running?",
    )


@source("udp", "MPEG-TS or RTP")
def _open_udp(uri: str, settings: SourceSettings) -> Source:
    stream = UdpStream(uri, settings)
    return LatestSource(
        without_password(uri), stream.open_capture, settings, advice="is the sender sending here?"
    )


@source("csi", "a CSI camera of a Raspberry Pi or Jetson")
def _open_csi(uri: str, settings: SourceSettings) -> Source:
    number, wanted = parse_csi_number(uri), csi_settings(uri, settings)
    check_csi_program(uri)
    return LatestSource(uri, lambda: CsiCapture(number, wanted), wanted)


@source("realsense", "a RealSense depth camera (extra `cameras`)")
def _open_realsense(uri: str, settings: SourceSettings) -> Source:
    module = load_module("pyrealsense2", uri)
    return LatestSource(
        uri, lambda: RealsenseCapture(_rest(uri), settings, module), settings, advice="is it plugged in?"
    )


@source("oak", "an OAK depth camera (extra `cameras`)")
def _open_oak(uri: str, settings: SourceSettings) -> Source:
    module = load_module("depthai", uri)
    return LatestSource(
        uri, lambda: OakCapture(_rest(uri), settings, module), settings, advice="is it plugged in?"
    )


@source("shm", "shared memory of this host")
def _open_shared(uri: str, settings: SourceSettings) -> Source:
    check_name(_rest(uri))
    return LatestSource(
        uri, lambda: SharedFrameCapture(_rest(uri), settings), settings, advice="is its writer running?"
    )


@source("ros", "a ROS 2 image topic, by `companion ros2 node`")
def _open_ros(uri: str, settings: SourceSettings) -> Source:
    address = parse_ros_address(uri)
    if address.depth is not None:
        colour, depth = str(replace(address, depth=None)), str(RosAddress(address.depth))
        return _open_with_depth(colour, depth, replace(settings, loop=False))
    return LatestSource(
        uri,
        lambda: SharedFrameCapture(address.segment, settings),
        settings,
        advice="is `companion ros2 node` running, and are images published?",
    )


def _rest(uri: str) -> str:
    """The part after `scheme://`."""
    return uri.partition("://")[2]


def _open_path(path: Path, settings: SourceSettings) -> Source:
    mode = _mode(path)
    if stat.S_ISFIFO(mode):
        return _open_fifo(path, settings)
    if not os.access(path, os.R_OK):
        raise SourceError(f"{path}: no permission to read it")
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise SourceError(f"{path}: neither a file, a folder, a FIFO nor a video device")
    if settings.as_depth and (stat.S_ISDIR(mode) or is_depth_image(path)):
        return _open_file(str(path), lambda: _depth_images(path, settings), settings)
    if stat.S_ISDIR(mode):
        return _open_file(
            str(path), lambda: ImagesCapture(images_in(path), _image_rate_hz(settings)), settings
        )
    if settings.pixel_format in RAW_PIXEL_FORMATS:
        check_pipe_settings(str(path), settings)
        return _open_file(str(path), lambda: PipeCapture(os.open(path, os.O_RDONLY), settings), settings)
    if is_image(path):
        return _open_file(str(path), lambda: ImagesCapture([path], _image_rate_hz(settings)), settings)
    return _open_file(str(path), lambda: VideoFileCapture(path), settings)


def check_there(uri: str) -> None:
    """Check, without opening it, that the file, FIFO or device that an address names exists.

    Raises:
        SourceUnavailableError: there is no such device or FIFO yet.
        SourceError: there is no such file.
    """
    if (device := camera_device(uri)) is not None:
        check_camera(device, SourceSettings())
    elif uri != "-" and ("://" not in uri or uri.startswith("file://")):
        _refuse_without_slashes(uri)
        _mode(Path(_rest(uri)) if "://" in uri else expanded(uri))


def _refuse_without_slashes(uri: str) -> None:
    if _WITHOUT_SLASHES.fullmatch(uri) and not expanded(uri).exists():
        raise SourceError(
            f"{HIDDEN}@{uri.rpartition('@')[2]}: an address with a password needs its scheme and ://, as in "
            "rtsp://USER:PASSWORD@HOST/PATH"
        )


def _mode(path: Path) -> int:
    try:
        return path.stat().st_mode
    except FileNotFoundError:
        error = SourceUnavailableError if path.suffix in _OF_PIPES else SourceError
        raise error(f"{path}: no such file, folder or device{_nearest(path)}") from None
    except OSError as error:
        raise SourceUnavailableError(f"{path}: cannot be opened: {error.strerror}") from error


def _folder(uri: str) -> Path | None:
    """The folder that an address names, None if it names something else."""
    path = Path(_rest(uri)) if uri.startswith("file://") else expanded(uri)
    return path if path.is_dir() else None


def _depth_images(path: Path, settings: SourceSettings) -> ImagesCapture:
    paths = images_in(path, DEPTH_SUFFIXES) if path.is_dir() else [path]
    return ImagesCapture(paths, _image_rate_hz(settings), read_depth)


def _open_file(name: str, open_capture: Callable[[], Capture], settings: SourceSettings) -> Source:
    def open_looping() -> Capture:
        return LoopingCapture(open_capture)

    opener = open_looping if settings.loop else open_capture
    if settings.realtime:
        return LatestSource(name, opener, settings, reopen=False, paced=True)
    return SequentialSource(name, opener, settings)


def _open_standard_input(settings: SourceSettings) -> Source:
    name = "standard input"
    check_pipe_settings(name, settings)
    if os.isatty(0):
        raise SourceError("standard input is a terminal; pipe frames into it, or give a source")

    def open_capture() -> Capture:
        return PipeCapture(os.dup(0), settings)

    is_file = stat.S_ISREG(os.fstat(0).st_mode)
    every_frame = settings.every_frame
    if every_frame is None:
        every_frame = is_file and not settings.realtime
    if every_frame:
        return SequentialSource(name, open_capture, settings)
    return LatestSource(name, open_capture, settings, reopen=False, paced=settings.realtime and is_file)


def _open_fifo(path: Path, settings: SourceSettings) -> Source:
    fifo = Fifo(path, settings)
    try:
        if settings.every_frame:
            return SequentialSource(str(path), fifo.open_capture, settings, on_close=fifo.close)
        return LatestSource(
            str(path), fifo.open_capture, settings, advice="start its writer", on_close=fifo.close
        )
    except BaseException:
        fifo.close()
        raise


def _image_rate_hz(settings: SourceSettings) -> float:
    return settings.rate_hz or _IMAGE_RATE_HZ


def _nearest(path: Path) -> str:
    """A hint: similar names in the same folder."""
    folder = path.parent
    if not folder.is_dir():
        return f" (the folder {folder} does not exist)"
    try:
        names = os.listdir(folder)
    except OSError:
        return ""
    close = difflib.get_close_matches(path.name, names, n=3, cutoff=0.5)
    return f"; did you mean {' or '.join(str(folder / name) for name in close)}?" if close else ""
