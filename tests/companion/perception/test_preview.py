"""Preview images are encoded and published only while there is a subscriber."""

from __future__ import annotations

import json
import math
import queue
import threading
import time
import uuid
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zenoh

from companion.bus.client import listen
from companion.perception.messages import CloudPreview, DepthPreview, Preview
from companion.perception.previews import MAX_CLOUD_POINTS, CloudEncoder, PreviewEncoder
from companion.settings import PreviewSection
from companion.settings.perception import CameraSection
from tests.companion.service_process import heartbeats, running_service
from vision.detections import Detections
from vision.frame import Frame
from vision.sources.shared import FrameSharing

pytestmark = pytest.mark.realtime

IMAGE = np.full((120, 160, 3), 90, np.uint8)
CAR = Detections(
    np.array([[20, 30, 90, 100]], np.float32), np.array([0.9], np.float32), np.array([0]), ("car",)
)


def previews_of(settings: PreviewSection, stamps_ns: list[int], *, watched: bool = True) -> list[Preview]:
    made: list[Preview] = []
    delivered = threading.Semaphore(0)

    def deliver(preview: Preview | DepthPreview) -> None:
        assert isinstance(preview, Preview)
        made.append(preview)
        delivered.release()

    encoder = PreviewEncoder(settings, deliver)
    encoder.watched = watched
    for sequence, stamp_ns in enumerate(stamps_ns):
        before = encoder._due_ns
        encoder.write(Frame(IMAGE, stamp_ns, sequence), CAR)
        if encoder._due_ns != before:
            assert delivered.acquire(timeout=10)
    encoder.close()
    return made


def test_preview_has_detections_and_frame_number() -> None:
    plain, drawn = (previews_of(PreviewSection(annotate=annotate), [5_000])[0] for annotate in (False, True))
    assert (drawn.sequence, drawn.captured_ns) == (0, 5_000)
    images = [cv2.imdecode(np.frombuffer(p.jpeg, np.uint8), cv2.IMREAD_COLOR) for p in (plain, drawn)]
    assert images[0] is not None
    assert images[1] is not None
    assert images[0].shape == images[1].shape == (120, 160, 3)
    assert np.abs(images[0].astype(int) - 90).max() < 10
    assert np.abs(images[1].astype(int) - 90).max() > 60


def test_previews_are_rate_limited_and_on_demand() -> None:
    stamps_ns = [number * 100_000_000 for number in range(10)]
    assert [p.sequence for p in previews_of(PreviewSection(rate_hz=2.5), stamps_ns)] == [0, 4, 8]
    assert previews_of(PreviewSection(), stamps_ns, watched=False) == []


def clouds_of(settings: PreviewSection, frames: list[Frame], *, watched: bool = True) -> list[CloudPreview]:
    made: queue.SimpleQueue[CloudPreview] = queue.SimpleQueue()
    encoder = CloudEncoder(settings, CameraSection(), made.put)
    encoder.watched = watched
    clouds = []
    for frame in frames:
        before = encoder._due_ns
        encoder.write(frame, CAR)
        if encoder._due_ns != before:
            clouds.append(made.get(timeout=10))
    encoder.close()
    return clouds


def wall(width: int, height: int, stamp_ns: int = 0) -> Frame:
    """A wall 4 m away, its lower half 3 m, its right half in another colour."""
    depth_m = np.full((height, width), 4.0, np.float32)
    depth_m[height // 2 :] = 3.0
    image = np.full((height, width, 3), (1, 2, 3), np.uint8)
    image[:, width // 2 :] = (4, 5, 6)
    return Frame(image, stamp_ns, stamp_ns // 100_000_000, depth_m)


def assert_is_of_the_wall(points: np.ndarray[Any, Any]) -> None:
    """For the default lens (80 deg wide), an image of 4:3 and voxels of at most 0.5 m."""
    x, y, z = points["xyz"].T
    np.testing.assert_allclose(z, np.where(y < 0, 4.0, 3.0), atol=1e-3)
    half_m = 4.0 * math.tan(math.radians(40.0))
    assert (x.min(), x.max()) == pytest.approx((-half_m, half_m), abs=0.5)
    assert (y.min(), y.max()) == pytest.approx((-0.75 * half_m, 0.75 * half_m * 3 / 4), abs=0.5)
    assert (points["rgba"] == np.where(x[:, None] < 0, (3, 2, 1, 255), (6, 5, 4, 255))).all()


@pytest.mark.parametrize("images", [True, False])
def test_depth_images_are_of_the_frames_of_the_images(images: bool) -> None:
    made: queue.SimpleQueue[Preview | DepthPreview] = queue.SimpleQueue()
    encoder = PreviewEncoder(PreviewSection(rate_hz=5.0), made.put)
    encoder.watched, encoder.depth = images, True
    found = []
    for frame in [wall(64, 48, number * 100_000_000) for number in range(4)] + [Frame(IMAGE, 10**9, 9)]:
        before = encoder._due_ns
        encoder.write(frame, CAR)
        if encoder._due_ns != before:
            found += [made.get(timeout=10) for _ in range(images + (frame.depth_m is not None))]
    encoder.close()
    depths = [each for each in found if isinstance(each, DepthPreview)]
    assert [each.sequence for each in depths] == [0, 2]
    assert [each.sequence for each in found if isinstance(each, Preview)] == [0, 2, 9] * images
    assert (depths[0].width, depths[0].height) == (64, 48)
    assert zlib.decompress(depths[0].data) == np.repeat(np.array([4000, 3000], "<u2"), 64 * 24).tobytes()


def test_cloud_has_points_and_colours_of_the_frame() -> None:
    (cloud,) = clouds_of(PreviewSection(cloud_range_m=100.0), [wall(160, 120, 500_000_000)])
    assert (cloud.sequence, cloud.captured_ns) == (5, 500_000_000)
    points = np.frombuffer(cloud.data, [("xyz", "<f4", 3), ("rgba", "u1", 4)])
    assert len(points) == cloud.points > 50
    assert_is_of_the_wall(points)


def test_clouds_of_large_frames_are_bounded() -> None:
    (cloud,) = clouds_of(PreviewSection(cloud_range_m=5.0), [wall(1920, 1080)])
    assert 10_000 < cloud.points <= MAX_CLOUD_POINTS
    assert len(cloud.data) <= 320_000


def test_clouds_are_rate_limited_and_on_demand() -> None:
    frames = [wall(64, 48, number * 100_000_000) for number in range(10)]
    assert [cloud.sequence for cloud in clouds_of(PreviewSection(), frames)] == [0, 5]
    assert clouds_of(PreviewSection(), frames, watched=False) == []
    assert clouds_of(PreviewSection(), [Frame(IMAGE, 0, 0)]) == []


@contextmanager
def shared_frames() -> Iterator[str]:
    """Frames of a wall in shared memory, ten a second; yields the name."""
    name, ended = f"wall-{uuid.uuid4().hex[:8]}", threading.Event()

    def write() -> None:
        for sequence in count():
            sharing.write(replace(wall(160, 120), captured_ns=time.monotonic_ns(), sequence=sequence))
            if ended.wait(0.1):
                break

    with FrameSharing(name) as sharing, ThreadPoolExecutor(1) as executor:
        writing = executor.submit(write)
        try:
            yield name
        finally:
            ended.set()
            writing.result()  # or its exception


def test_images_clouds_and_depth_only_with_a_subscriber(tmp_path: Path) -> None:
    statuses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()

    def published() -> dict[str, int]:
        while not statuses.empty():
            statuses.get()
        counts: dict[str, int] = statuses.get(timeout=10)["bus"]["published"]
        return {name: counts[name] for name in ("image", "cloud", "depth_image")}

    def sample_of(session: zenoh.Session, topic: str) -> tuple[zenoh.Sample, dict[str, Any]]:
        """One sample and its attachment, from a subscriber that is gone then."""
        samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        with session.declare_subscriber(f"companion/*/{topic}", samples.put):
            sample = samples.get(timeout=30)
        assert sample.attachment is not None
        return sample, json.loads(sample.attachment.to_string())

    with (
        heartbeats() as port,
        shared_frames() as name,
        running_service(
            port, ["--source", f"shm://{name}", "--detector-enabled", "false"], cwd=tmp_path
        ) as service,
        service.client() as session,
    ):
        listen(session, "status", lambda _key, text: statuses.put(json.loads(text)))
        assert published() == {"image": 0, "cloud": 0, "depth_image": 0}
        cloud, about_cloud = sample_of(session, "cloud")
        depth, about_depth = sample_of(session, "depth_image")
        jpeg, about_image = sample_of(session, "image")
        # The subscribers have gone: the counts stop.
        before, now = published(), published()
        while now != before:
            before, now = now, published()
        assert min(now.values()) > 0
    image = cv2.imdecode(np.frombuffer(jpeg.payload.to_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (120, 160, 3)
    assert jpeg.encoding == zenoh.Encoding.IMAGE_JPEG
    assert about_image["camera"] is None
    assert about_cloud["frame_id"] == "vehicle1/camera"
    points = np.frombuffer(cloud.payload.to_bytes(), [("xyz", "<f4", 3), ("rgba", "u1", 4)])
    assert len(points) == about_cloud["points"] > 50
    assert_is_of_the_wall(points)
    millimetres = np.frombuffer(zlib.decompress(depth.payload.to_bytes()), "<u2")
    assert len(millimetres) == about_depth["width"] * about_depth["height"] == 160 * 120
    assert (millimetres == np.repeat([4000, 3000], 160 * 60)).all()
