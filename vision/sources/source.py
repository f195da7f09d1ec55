"""The source interface: settings, statistics, errors, and `read`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Self

from vision.camera_model import CameraCalibration
from vision.frame import Frame
from vision.orientation import Orientation
from vision.redaction import redacted

RAW_PIXEL_FORMATS = {"bgr24": 3.0, "rgb24": 3.0, "gray8": 1.0, "yuv420": 1.5, "gray16": 2.0}
"""Raw pixel formats of a pipe → bytes per pixel."""

PIPE_PIXEL_FORMATS = (*RAW_PIXEL_FORMATS, "y4m", "mjpeg")


class SourceError(Exception):
    """A source cannot be opened, or cannot continue. The text is one line that says what to do.

    Passwords in it are replaced by stars.
    """

    def __init__(self, text: str = "") -> None:
        super().__init__(redacted(text))


class SourceUnavailableError(SourceError):
    """The source is not there now, or gives no frame. It may come: opening it again may succeed."""


class NoFrameError(SourceError):
    """The source has ended before its first frame."""


class CameraChangedError(SourceError):
    """The source returned with another lens or mount; open it again to use that."""


class EndOfStream(Exception):  # noqa: N818 - an end, not an error
    """The source has delivered its last frame."""


@dataclass(frozen=True, slots=True)
class SourceSettings:
    """How to open and read a source. A kind of source ignores what does not apply to it.

    Attributes:
        width, height: pixels. Requested from a camera; required for a raw pipe; unused otherwise.
        rate_hz: frames per second. Requested from a camera; the rate of images and raw files with `realtime`.
        pixel_format: a camera's FOURCC (`MJPG`, `YUYV`), or the format of a pipe: `bgr24`, `rgb24`, `gray8`,
            `yuv420` (these need width and height), `y4m`, `mjpeg`. None: the driver's default, or y4m/mjpeg
            detected from the pipe's first bytes. Of a CSI camera: `yuv420` (default) or `mjpeg`.
        exposure_us: exposure time of a camera, microseconds; None: automatic, of V4L2 left as it is.
        gain: of a camera; of a CSI camera a factor, of a V4L2 camera in the driver's unit; None as
            `exposure_us`.
            Sources without exposure time or gain refuse them.
        rotate_deg, mirror: mirror the image left to right, then rotate it clockwise by 0, 90, 180 or 270
            degrees; depth and the source's own calibration as well, see `vision.orientation`. `width` and
            `height` are those before it.
        name: for people, in messages before the address.
        depth: address of a second source with the depth of this one's images, registered to them: 16-bit
            PNG, 32-bit TIFF or OpenEXR, NPY, a pipe of raw `gray16`, or shared memory with depth. Two folders
            are paired by file name, other sources by stamp, see `vision.sources.paired`.
        depth_scale: metres per unit of that depth; None: 0.001 for 16-bit integers, 1 for floats.
        depth_calibration_file: of a depth camera whose images are not registered, as `companion calibrate
            extrinsics` writes it.
        as_depth: deliver depth images: `depth_m` with a black image. Set for the source that `depth` names.
        loop: restart a file at its end. Refused with `depth`.
        realtime: read a file at its own frame rate, newest frame wins: a file used as a camera. A pipe has
            its writer's rate.
        every_frame: pipes only. True: every frame in order, the writer waits for the reader, and the writer's
            exit is the end. False: newest frame wins. None: newest wins, but a regular file redirected to
            standard input is read completely. Files deliver every frame unless `realtime`; cameras, networks
            and shared memory cannot wait, so the newest always wins.
        open_timeout_s: timeout for the first frame.
        read_timeout_s: a live source without data for this long is lost, and is reopened.
        retry_min_s, retry_max_s: the pause between attempts starts at the first and doubles up to the second.
        on_frame: called with every frame as it arrives, before the reader gets it, including frames that the
            reader is too slow for. A live source calls it in its own thread. A `SourceError` raised here ends
            the source.

    >>> from vision import SourceSettings
    >>> SourceSettings(width=640, height=480, pixel_format="MJPG").read_timeout_s
    5.0
    """

    width: int | None = None
    height: int | None = None
    rate_hz: float | None = None
    pixel_format: str | None = None
    exposure_us: float | None = None
    gain: float | None = None
    rotate_deg: int = 0
    mirror: bool = False
    name: str | None = None
    depth: str | None = None
    depth_scale: float | None = None
    depth_calibration_file: str | None = None
    as_depth: bool = False
    loop: bool = False
    realtime: bool = False
    every_frame: bool | None = None
    open_timeout_s: float = 10.0
    read_timeout_s: float = 5.0
    retry_min_s: float = 0.5
    retry_max_s: float = 10.0
    on_frame: Callable[[Frame], None] | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if value is not None and not 1 <= value <= 32768:
                raise ValueError(f"{name} must be 1..32768 pixels, got {value}")
        if self.rate_hz is not None and not 0.0 < self.rate_hz <= 1000.0:
            raise ValueError(f"rate_hz must be above 0 and at most 1000, got {self.rate_hz}")
        if self.exposure_us is not None and not 1.0 <= self.exposure_us <= 1e7:
            raise ValueError(f"exposure_us must be 1..10000000 us, got {self.exposure_us}")
        if self.gain is not None and not 0.0 <= self.gain <= 1e6:
            raise ValueError(f"gain must be 0..1000000, got {self.gain}")
        if self.depth_scale is not None and not 0.0 < self.depth_scale <= 1000.0:
            raise ValueError(f"depth_scale must be above 0 and at most 1000 m, got {self.depth_scale}")
        Orientation(self.rotate_deg)
        for name in ("open_timeout_s", "read_timeout_s", "retry_min_s"):
            if not 0.0 < getattr(self, name) <= 3600.0:
                raise ValueError(f"{name} must be above 0 and at most 3600 s, got {getattr(self, name)}")
        if not self.retry_min_s <= self.retry_max_s <= 3600.0:
            raise ValueError(
                f"retry_max_s must be from retry_min_s ({self.retry_min_s}) to 3600 s, got {self.retry_max_s}"
            )
        if self.pixel_format is not None and not (
            self.pixel_format in PIPE_PIXEL_FORMATS or len(self.pixel_format) == 4
        ):
            raise ValueError(
                f"pixel_format must be a camera's FOURCC (MJPG, YUYV) or one of "
                f"{', '.join(PIPE_PIXEL_FORMATS)}, got {self.pixel_format!r}"
            )

    @property
    def orientation(self) -> Orientation:
        """What is done with each image; false if nothing."""
        return Orientation(self.rotate_deg, self.mirror)


@dataclass(frozen=True, slots=True)
class SourceStatistics:
    """Counts since the source was opened.

    Attributes:
        delivered: frames that `read` returned.
        dropped: frames replaced by a newer one before they were read.
        unreadable: frames that could not be decoded.
        reopened: number of recoveries of a lost source.
    """

    delivered: int = 0
    dropped: int = 0
    unreadable: int = 0
    reopened: int = 0


class Source(ABC):
    """An open source of frames. Use it as a context manager, or iterate it to its end.

    Attributes:
        uri: address of the source, without passwords.
        live: True: the newest frame wins; False: every frame is delivered.
        total_frames: number of frames, None if unknown. A video file's header may be slightly wrong.
        calibration: lens and mount, if the source provides them (shared memory can); constant while the
            source is open.

    >>> import tempfile
    >>> import cv2, numpy as np
    >>> from vision import Source, open_source
    >>> folder = tempfile.TemporaryDirectory()
    >>> cv2.imwrite(f"{folder.name}/photo.png", np.zeros((120, 160, 3), np.uint8))
    True
    >>> def shapes(source: Source) -> list[tuple[str, tuple[int, ...]]]:
    ...     return [(frame.file_name, frame.image.shape) for frame in source]
    >>> with open_source(folder.name) as source:
    ...     shapes(source)
    [('photo.png', (120, 160, 3))]
    """

    uri: str
    live: bool
    total_frames: int | None = None
    calibration: CameraCalibration | None = None

    @abstractmethod
    def read(self, timeout_s: float = 1.0) -> Frame | None:
        """The next frame.

        A live source returns its newest frame, each at most once, waiting up to `timeout_s`; None if none
        arrived (also while a lost source is being reopened: keep reading). Other sources return every frame
        in order; a file never returns None, a pipe does if its writer is late.

        Raises:
            EndOfStream: after the last frame, and after `close`.
            SourceError: the source failed permanently.
        """

    @property
    @abstractmethod
    def statistics(self) -> SourceStatistics:
        """The counts so far."""

    @abstractmethod
    def close(self) -> None:
        """Release the device, file or socket. A second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        """Every frame until the end; a live source that recovers never ends."""
        while True:
            try:
                frame = self.read()
            except EndOfStream:
                return
            if frame is not None:
                yield frame


class OneFrame(Source):
    """Gives the frame that was put in, once: for a pipeline that is stepped by hand."""

    uri, live = "one frame", True

    def __init__(self) -> None:
        self.frame: Frame | None = None

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        if self.frame is None:
            raise EndOfStream("no frame was put in")
        frame, self.frame = self.frame, None
        return frame

    @property
    def statistics(self) -> SourceStatistics:
        return SourceStatistics()

    def close(self) -> None:
        self.frame = None
