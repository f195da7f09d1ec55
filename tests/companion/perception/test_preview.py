"""Preview images are encoded and published only while there is a subscriber."""

from __future__ import annotations

import json
import queue
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zenoh

from companion.bus.client import listen
from companion.perception.messages import Preview
from companion.perception.worker import PreviewEncoder
from companion.settings import PreviewSection
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

    def deliver(preview: Preview) -> None:
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
