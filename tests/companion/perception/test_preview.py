"""Preview images are encoded and published only while there is a subscriber."""

from __future__ import annotations

import json
import queue
import threading
import uuid
import zlib
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
from mavlink_sim.testing import running_simulator
from tests.companion.service_process import running_service
from vision.detections import Detections
from vision.frame import Frame

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
    depth_m = np.full((height, width), 4.0, np.float32)
    return Frame(np.full((height, width, 3), (1, 2, 3), np.uint8), stamp_ns, stamp_ns // 100_000_000, depth_m)


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
    assert zlib.decompress(depths[0].data) == np.full(64 * 48, 4000, "<u2").tobytes()


def test_cloud_has_points_and_colours_of_the_frame() -> None:
    (cloud,) = clouds_of(PreviewSection(cloud_voxel_m=0.5), [wall(160, 120, 500_000_000)])
    assert (cloud.sequence, cloud.captured_ns) == (5, 500_000_000)
    points = np.frombuffer(cloud.data, [("xyz", "<f4", 3), ("rgba", "u1", 4)])
    assert len(points) == cloud.points > 50
    np.testing.assert_allclose(points["xyz"][:, 2], 4.0, atol=1e-4)
    assert (points["rgba"] == (3, 2, 1, 255)).all()


def test_clouds_of_large_frames_are_bounded() -> None:
    (cloud,) = clouds_of(PreviewSection(cloud_voxel_m=0.02), [wall(1920, 1080)])
    assert 10_000 < cloud.points <= MAX_CLOUD_POINTS
    assert len(cloud.data) <= 320_000


def test_clouds_are_rate_limited_and_on_demand() -> None:
    frames = [wall(64, 48, number * 100_000_000) for number in range(10)]
    assert [cloud.sequence for cloud in clouds_of(PreviewSection(), frames)] == [0, 5]
    assert clouds_of(PreviewSection(), frames, watched=False) == []
    assert clouds_of(PreviewSection(), [Frame(IMAGE, 0, 0)]) == []


def test_clouds_and_depth_images_only_with_a_subscriber(tmp_path: Path) -> None:
    camera = f"cloud-{uuid.uuid4().hex[:8]}"
    scene = tmp_path / "bare.toml"
    scene.write_text('[ground]\nkinds = ["concrete"]\ntile_texels = 256\ntexel_m = 0.05\n')
    flags = [
        *("--source", f"shm://{camera}", "--detector-enabled", "false"),
        *("--guidance-perception-max-age-s", "3"),
    ]
    samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    statuses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    with (
        running_simulator(scene=scene, camera=camera, camera_rate=5.0, seed=5) as simulator,
        running_service(simulator.onboard_port, flags, cwd=tmp_path) as service,
        service.client() as session,
    ):
        listen(session, "status", lambda _key, text: statuses.put(json.loads(text)))
        published = statuses.get(timeout=10)["bus"]["published"]
        assert (published["cloud"], published["depth_image"]) == (0, 0)
        with session.declare_subscriber("companion/*/cloud", samples.put):
            sample = samples.get(timeout=30)
        with session.declare_subscriber("companion/*/depth_image", samples.put):
            image = samples.get(timeout=30)
    assert sample.attachment is not None
    about = json.loads(sample.attachment.to_string())
    assert about["frame_id"] == "vehicle1/camera"
    points = np.frombuffer(sample.payload.to_bytes(), [("xyz", "<f4", 3), ("rgba", "u1", 4)])
    assert len(points) == about["points"] > 100
    assert 0.0 < points["xyz"][:, 2].min() < points["xyz"][:, 2].max() < 20.5
    assert image.attachment is not None
    size = json.loads(image.attachment.to_string())
    millimetres = np.frombuffer(zlib.decompress(image.payload.to_bytes()), "<u2")
    assert len(millimetres) == size["width"] * size["height"]
    assert np.count_nonzero(millimetres) > 1000


def test_previews_only_with_a_subscriber(seeing: list[str], tmp_path: Path) -> None:
    statuses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()

    def images_published() -> int:
        while not statuses.empty():
            statuses.get()
        return int(statuses.get(timeout=10)["bus"]["published"]["image"])

    with (
        running_simulator() as simulator,
        running_service(simulator.onboard_port, seeing, cwd=tmp_path) as service,
        service.client() as session,
    ):
        listen(session, "status", lambda _key, text: statuses.put(json.loads(text)))
        assert images_published() == 0
        with session.declare_subscriber("companion/*/image", samples.put):
            sample = samples.get(timeout=30)
        image = cv2.imdecode(np.frombuffer(sample.payload.to_bytes(), np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert image.shape == (120, 160, 3)
        assert sample.encoding == zenoh.Encoding.IMAGE_JPEG
        assert sample.attachment is not None
        assert json.loads(sample.attachment.to_string())["camera"] is None
        # The subscriber has gone: the count stops.
        before, now = images_published(), images_published()
        while now != before:
            before, now = now, images_published()
        assert now > 0
