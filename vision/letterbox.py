"""Fitting a frame into the network's input: resized with its aspect kept, padded with grey, and the inverse.

The conventions (padding value 114, side of the odd pixel, rounding) are those of published YOLOv8 networks;
half a pixel of offset costs accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Placement = Literal["centre", "corner", "stretch"]

PADDING = 114
STRIDE = 32


@dataclass(frozen=True, slots=True)
class Letterbox:
    """Position of a frame in the network's input. All sizes in pixels.

    Attributes:
        frame_width, frame_height: the frame.
        width, height: the network's input, multiples of the stride.
        resized_width, resized_height: the frame inside the input.
        left, top: of the frame inside the input.
    """

    frame_width: int
    frame_height: int
    width: int
    height: int
    resized_width: int
    resized_height: int
    left: int
    top: int

    def apply(self, image: NDArray[np.uint8], into: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """(frame_height, frame_width, 3) uint8 → (height, width, 3) uint8, the same channel order.

        Args:
            into: a result of `blank` or of an earlier call on this letterbox; it is overwritten, which saves
                allocating and padding a new one. None: a new one.

        Returns:
            `into`, a new array, or the frame itself if it already has the input's size.
        """
        if image.shape != (self.frame_height, self.frame_width, 3):
            raise ValueError(
                f"this letterbox is for ({self.frame_height}, {self.frame_width}, 3), got {image.shape}"
            )
        if (self.width, self.height) == (self.frame_width, self.frame_height):
            return image
        boxed = self.blank() if into is None else into
        inside = boxed[self.top : self.top + self.resized_height, self.left : self.left + self.resized_width]
        if (self.resized_width, self.resized_height) == (self.frame_width, self.frame_height):
            inside[:] = image
        else:
            size = (self.resized_width, self.resized_height)
            if cv2.resize(image, size, dst=inside, interpolation=cv2.INTER_LINEAR) is not inside:
                raise RuntimeError("cv2.resize did not write in place")
        return boxed

    def blank(self) -> NDArray[np.uint8]:
        """(height, width, 3) uint8, filled with padding."""
        return np.full((self.height, self.width, 3), PADDING, np.uint8)

    def to_frame(self, xyxy: NDArray[Any]) -> NDArray[np.float32]:
        """(N, 4) boxes in the network's input → (N, 4) float32 in the frame, clipped to it."""
        boxes = (np.asarray(xyxy, np.float32).reshape(-1, 4) - self._corner) / self._scale
        limits = np.array([self.frame_width, self.frame_height] * 2, np.float32)
        clipped: NDArray[np.float32] = np.clip(boxes, 0, limits, dtype=np.float32)
        return clipped

    @property
    def _scale(self) -> NDArray[np.float32]:
        # Sizes are whole pixels, so the scales of the two axes differ slightly, which matters for small
        # boxes.
        across, down = self.resized_width / self.frame_width, self.resized_height / self.frame_height
        return np.array([across, down] * 2, np.float32)

    @property
    def _corner(self) -> NDArray[np.float32]:
        return np.array([self.left, self.top] * 2, np.float32)


def fit_into(
    frame_width: int, frame_height: int, width: int, height: int, placement: Placement = "centre"
) -> Letterbox:
    """Compute the letterbox for an input of a fixed size.

    Args:
        placement: `centre` or `corner` (upper left), the rest is padding; or `stretch`, without padding.
    """
    if frame_width < 1 or frame_height < 1:
        raise ValueError(f"a frame must have a positive size, got {frame_width}x{frame_height}")
    resized_width, resized_height = width, height
    if placement != "stretch":
        scale = min(width / frame_width, height / frame_height)
        # YOLOX, which pads at the right and the bottom, rounds down.
        rounded = int if placement == "corner" else round
        resized_width = min(width, max(1, rounded(frame_width * scale)))
        resized_height = min(height, max(1, rounded(frame_height * scale)))
    centred = placement == "centre"
    return Letterbox(
        frame_width=frame_width,
        frame_height=frame_height,
        width=width,
        height=height,
        resized_width=resized_width,
        resized_height=resized_height,
        left=(width - resized_width) // 2 if centred else 0,
        top=(height - resized_height) // 2 if centred else 0,
    )


def fit(
    frame_width: int, frame_height: int, image_size: int = 640, *, square: bool = False, stride: int = STRIDE
) -> Letterbox:
    """Compute the letterbox for frames of one size.

    Args:
        image_size: the input's longer side, a multiple of the stride.
        square: pad to image_size × image_size; else only to the next multiple of the stride (faster).
        stride: the network's largest, pixels.
    """
    if frame_width < 1 or frame_height < 1:
        raise ValueError(f"a frame must have a positive size, got {frame_width}x{frame_height}")
    if image_size < stride or image_size % stride:
        raise ValueError(f"image_size must be a multiple of {stride} (such as 640), got {image_size}")
    scale = min(image_size / frame_height, image_size / frame_width)
    # A frame a thousand times wider than high still keeps one row of pixels.
    resized_width = max(1, round(frame_width * scale))
    resized_height = max(1, round(frame_height * scale))
    spare_width, spare_height = image_size - resized_width, image_size - resized_height
    if not square:
        spare_width, spare_height = spare_width % stride, spare_height % stride
    return Letterbox(
        frame_width=frame_width,
        frame_height=frame_height,
        width=resized_width + spare_width,
        height=resized_height + spare_height,
        resized_width=resized_width,
        resized_height=resized_height,
        # An odd pixel of padding goes to the right and to the bottom.
        left=spare_width // 2,
        top=spare_height // 2,
    )
