"""One small source of every kind, all of which show the same image."""

from __future__ import annotations

import contextlib
import os
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter

WIDTH, HEIGHT, FRAMES = 384, 288, 4
# The white square in the lower right corner, and the marker at the left.
SQUARE_PX, MARKER_ID, MARKER_DICTIONARY = 72, 3, "4X4_50"
SQUARE_DEPTH_M, OTHER_DEPTH_M = 2.0, 4.0


@dataclass(frozen=True)
class Given:
    """A source as the command line takes it.

    Attributes:
        uri: the argument SOURCE. flags: settings that belong to it, as flags.
        frames: how many it delivers; None: without an end, or fewer if the reader is slow.
        depth: whether its frames have depth.
        standard_input: what is written to standard input.
    """

    uri: str
    flags: tuple[str, ...] = ()
    frames: int | None = FRAMES
    depth: bool = False
    standard_input: bytes = b""


def image() -> NDArray[np.uint8]:
    """Dark grey, with a marker at the left, the white square at the lower right, and no two equal rows."""
    image = np.full((HEIGHT, WIDTH), 40, np.uint8)
    image[:, ::8] = np.arange(HEIGHT, dtype=np.uint8)[:, None] // 8 + 20
    image[100:220, 20:140] = 255
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image[112:208, 32:128] = cv2.aruco.generateImageMarker(dictionary, MARKER_ID, 96)
    image[-SQUARE_PX:, -SQUARE_PX:] = 255
    return image


def depth_mm() -> NDArray[np.uint16]:
    depth = np.full((HEIGHT, WIDTH), OTHER_DEPTH_M * 1000, np.uint16)
    depth[-SQUARE_PX:, -SQUARE_PX:] = SQUARE_DEPTH_M * 1000
    return depth


def colour() -> NDArray[np.uint8]:
    return np.ascontiguousarray(cv2.cvtColor(image(), cv2.COLOR_GRAY2BGR), np.uint8)


def jpeg(image: NDArray[np.uint8] | None = None) -> bytes:
    return cv2.imencode(".jpg", colour() if image is None else image)[1].tobytes()


def write_images(folder: Path, suffix: str, image: NDArray[Any]) -> str:
    folder.mkdir()
    for index in range(FRAMES):
        assert cv2.imwrite(str(folder / f"{index}{suffix}"), image)
    return str(folder)


def write_video(path: Path, fourcc: str, image: NDArray[np.uint8]) -> Path:
    height, width = image.shape[:2]
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*fourcc), 20.0, (width, height)
    )
    for _ in range(FRAMES):
        writer.write(image)
    writer.release()
    return path


def lying() -> NDArray[np.uint8]:
    """The image as a camera stores it that was turned; rotated clockwise it is upright."""
    return np.ascontiguousarray(cv2.rotate(colour(), cv2.ROTATE_90_COUNTERCLOCKWISE), np.uint8)


def with_orientation(data: bytes, orientation: int) -> bytes:
    """A JPEG with an EXIF orientation."""
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0MM\0*" + struct.pack(">IH", 8, 1) + entry + bytes(4)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]


def rotate_video(path: Path) -> None:
    """Write "rotate clockwise by 90 degrees" into the track header of an MP4 file (ISO 14496-12, 8.3.2)."""
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40
    data[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


@contextmanager
def images(folder: Path) -> Iterator[Given]:
    yield Given(write_images(folder / "images", ".jpg", colour()))


@contextmanager
def video(folder: Path) -> Iterator[Given]:
    yield Given(str(write_video(folder / "street.webm", "VP80", colour())))


@contextmanager
def rotated(folder: Path) -> Iterator[Given]:
    path = folder / "turned"
    path.mkdir()
    for index in range(FRAMES):
        (path / f"{index}.jpg").write_bytes(with_orientation(jpeg(lying()), 6))
    yield Given(str(path))


@contextmanager
def rotated_video(folder: Path) -> Iterator[Given]:
    path = write_video(folder / "turned.mp4", "mp4v", lying())
    rotate_video(path)
    yield Given(str(path))


@contextmanager
def grey(folder: Path) -> Iterator[Given]:
    yield Given(write_images(folder / "grey", ".png", image()))


@contextmanager
def sixteen_bit(folder: Path) -> Iterator[Given]:
    yield Given(write_images(folder / "sixteen", ".png", image().astype(np.uint16) * 257))


@contextmanager
def pipe(folder: Path) -> Iterator[Given]:
    yield Given("-", frames=None, standard_input=jpeg() * FRAMES)


@contextmanager
def depth(folder: Path) -> Iterator[Given]:
    uri = write_images(folder / "colour", ".png", colour())
    beside = write_images(folder / "depth", ".png", depth_mm())
    yield Given(uri, ("--source-depth", beside), depth=True)


@contextmanager
def live(folder: Path) -> Iterator[Given]:
    """Motion JPEG over HTTP, 30 a second."""
    ending = threading.Event()

    class Camera(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            data = jpeg()
            with contextlib.suppress(OSError):
                while not ending.wait(1 / 30):
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    self.wfile.write(head.encode() + data + b"\r\n")

        def log_message(self, format: str, *arguments: Any) -> None:
            """No log output in tests."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Camera) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield Given(f"http://127.0.0.1:{server.server_address[1]}/video", frames=None)
        ending.set()
        server.shutdown()
        thread.join()


@contextmanager
def live_depth(folder: Path) -> Iterator[Given]:
    """Shared memory with depth, 30 a second."""
    name = f"companion-test-{os.getpid()}-{time.monotonic_ns()}"
    ending = threading.Event()
    writer = SharedFrameWriter(name, WIDTH, HEIGHT, depth=True)
    image, depth_m = colour(), (depth_mm() / 1000).astype(np.float32)

    def write() -> None:
        sequence = 0
        while not ending.wait(1 / 30):
            writer.write(Frame(image, time.monotonic_ns(), sequence, depth_m))
            sequence += 1

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    try:
        yield Given(f"shm://{name}", frames=None, depth=True)
    finally:
        ending.set()
        thread.join()
        writer.close()


KINDS: dict[str, Callable[[Path], contextlib.AbstractContextManager[Given]]] = {
    "video": video,
    "images": images,
    "depth": depth,
    "live depth": live_depth,
    "rotated": rotated,
    "rotated video": rotated_video,
    "grey": grey,
    "16 bit": sixteen_bit,
    "pipe": pipe,
    "live": live,
}


@contextmanager
def written_to_standard_input(data: bytes) -> Iterator[None]:
    """Replace standard input of this process by a pipe whose writer writes this and ends."""
    kept = os.dup(0)
    out, into = os.pipe()
    os.dup2(out, 0)
    os.close(out)

    def write() -> None:
        with contextlib.suppress(BrokenPipeError), os.fdopen(into, "wb") as stream:
            stream.write(data)

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.dup2(kept, 0)
        os.close(kept)
        thread.join()
