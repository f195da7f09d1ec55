"""Published tracks: a real service, a real zenoh network."""

from __future__ import annotations

import json
import queue
from pathlib import Path
from typing import Any

import pytest

from companion.bus.client import listen
from tests.companion.service_process import heartbeats, running_service

pytestmark = pytest.mark.realtime


def test_identities_and_their_events_are_published(seeing: list[str], tmp_path: Path) -> None:
    # An untrained network has low confidences; all its non-overlapping boxes are used.
    flags = [
        *seeing,
        *("--confidence", "0", "--detector-iou", "0.05"),
        *("--tracker-high-confidence", "0", "--tracker-low-confidence", "0", "--tracker-confirm-score", "0"),
    ]
    with (
        heartbeats() as port,
        running_service(port, flags, cwd=tmp_path) as service,
        service.client() as session,
    ):
        tracks: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        detections: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        listen(session, "tracks", lambda _key, text: tracks.put(json.loads(text)))
        listen(session, "detections", lambda _key, text: detections.put(json.loads(text)))
        message = tracks.get(timeout=30)
        frame = detections.get(timeout=30)
        while frame["sequence"] < message["sequence"]:
            frame = detections.get(timeout=30)
        while message["sequence"] < frame["sequence"]:
            message = tracks.get(timeout=30)
    assert message["captured_ns"] == frame["captured_ns"]
    assert message["vehicle"] == "vehicle1"
    assert message["camera"] is None
    updates = {e["track_id"] for e in message["events"] if e["event"] in ("new", "update")}
    assert updates
    assert updates == {f["track_id"] for f in frame["detections"] if f["track_state"] == "confirmed"}
    assert frame["timing_ms"]["track"] >= 0
