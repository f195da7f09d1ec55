"""Finds identical images: a frame whose content is that of the frame before shows nothing new.

A camera, driver or decoder that hangs may repeat its last image with new stamps. No two images of a real
sensor are identical, because of its noise. An image without texture has no noise either, as at night, clipped
to black, or an empty sky of a simulator: it says nothing. Of images with more than `MAX_ROWS` every second
row is compared, and so on. Measured (median, busy computer): 0.08 ms for a new image of 640 x 480, 0.2 ms for
the same one again, 0.22 and 0.40 ms with depth; 0.15 and 0.35 ms for 1280 x 720.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vision.frame import Frame

MAX_ROWS = 600
# Without texture at most this share of the values, of every 16th row, differs from the first of their row: a
# lamp, or defective pixels.
TEXTURED_SHARE, TEXTURE_ROWS = 0.01, 16


class _Plane:
    """One kind of image of a source: colour or depth.

    Attributes:
        since_ns: capture of the first of the identical images that end with the newest.
        repeated: images so far that were identical to the one before.
    """

    def __init__(self) -> None:
        self.since_ns = 0
        self.repeated = 0
        self._kept: NDArray[np.generic] | None = None

    def update(self, image: NDArray[np.generic], captured_ns: int) -> int:
        """Compare with the image before; returns `since_ns`."""
        rows = image[:: -(-image.shape[0] // MAX_ROWS)]
        kept = self._kept
        if kept is None or kept.shape != rows.shape:
            self._kept = rows.copy()  # never a reference: a source may reuse its memory
        elif _identical(kept, rows) and _has_texture(rows):
            self.repeated += 1
            return self.since_ns
        else:
            np.copyto(kept, rows)
        self.since_ns = captured_ns
        return captured_ns


def _identical(one: NDArray[np.generic], other: NDArray[np.generic]) -> bool:
    """Whether two images of one size are; of most others one row already shows it."""
    middle = len(one) // 2
    return np.array_equal(one[middle], other[middle]) and np.array_equal(one, other)


def _has_texture(rows: NDArray[np.generic]) -> bool:
    """Whether there is more in an image than rows of one value each, as of a sky."""
    some = rows[::TEXTURE_ROWS]
    return bool(np.count_nonzero(some != some[:, :1]) > TEXTURED_SHARE * some.size)


class FrameChanges:
    """Stamps each frame with the capture of the first frame with the same colour image, and depth image.

    >>> import numpy as np
    >>> from vision import Frame
    >>> changes, image = FrameChanges(), np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    >>> [changes.stamped(Frame(image, captured_ns, 0)).image_since_ns for captured_ns in (100, 200)]
    [100, 100]
    >>> changes.repeated
    {'image': 1, 'depth': 0}
    """

    def __init__(self) -> None:
        self._image, self._depth = _Plane(), _Plane()

    @property
    def repeated(self) -> dict[str, int]:
        """Frames so far whose colour image (`image`), or whose `depth`, was that of the frame before."""
        return {"image": self._image.repeated, "depth": self._depth.repeated}

    def stamped(self, frame: Frame) -> Frame:
        """The frame with `image_since_ns` and `depth_since_ns`.

        An image without texture is no repeated one, nor is depth that is unknown everywhere.
        """
        depth_ns = None
        image_ns = self._image.update(frame.image, frame.captured_ns)
        if frame.depth_m is not None:
            # As bits: NaN is not equal to itself.
            depth_ns = self._depth.update(frame.depth_m.view(np.uint32), frame.captured_ns)
        return replace(frame, image_since_ns=image_ns, depth_since_ns=depth_ns)
