"""One frame from a source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A colour image with its capture stamp.

    Attributes:
        image: (height, width, 3) uint8, BGR, C-contiguous.
        captured_ns: CLOCK_MONOTONIC nanoseconds (`time.monotonic_ns`) of the capture, or of the arrival of
            its bytes if the source does not know the capture time.
        sequence: counts every frame the source delivered, from 0. A gap means dropped frames.
        depth_m: (height, width) float32, metres along the optical axis, NaN where unknown; None without
            depth.
        ready_ns: CLOCK_MONOTONIC nanoseconds when the image was decoded; 0 if unknown.
        decode_ms: decoding time, milliseconds.
        media_s: time in the recording or stream, seconds since its start, which increases; None without one.
        file_name: of the image or video, without folder; empty if the frame is not from a file.
        image_since_ns: capture of the first of the identical colour images that end with this one; None: not
            compared (`FrameChanges`). depth_since_ns: the same of the depth images.

    >>> import time
    >>> import numpy as np
    >>> from vision import Frame
    >>> frame = Frame(np.zeros((120, 160, 3), np.uint8), captured_ns=time.monotonic_ns(), sequence=0)
    >>> frame.width, frame.height
    (160, 120)
    """

    image: NDArray[np.uint8]
    captured_ns: int
    sequence: int
    depth_m: NDArray[np.float32] | None = None
    ready_ns: int = 0
    decode_ms: float = 0.0
    media_s: float | None = None
    file_name: str = ""
    image_since_ns: int | None = None
    depth_since_ns: int | None = None

    def __post_init__(self) -> None:
        if self.image.ndim != 3 or self.image.shape[2] != 3 or self.image.dtype != np.uint8:
            raise ValueError(
                f"Frame.image must be (height, width, 3) uint8, got {self.image.shape} {self.image.dtype}"
            )
        if self.depth_m is not None and self.depth_m.shape != self.image.shape[:2]:
            raise ValueError(
                f"Frame.depth_m must have the image's size {self.image.shape[:2]}, got {self.depth_m.shape}"
            )

    @property
    def width(self) -> int:
        return int(self.image.shape[1])

    @property
    def height(self) -> int:
        return int(self.image.shape[0])
