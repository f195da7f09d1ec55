"""The service's Prometheus metrics over HTTP."""

from __future__ import annotations

import json
import queue
import re
import socket
import sys
import threading
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from companion.bus.client import listen
from companion.host.passing import AddressTakenError
from companion.operator.metrics import MetricsError, MetricsServer
from companion.operator.wsgi_server import MAX_CONNECTIONS
from mavlink_sim.testing import free_port
from tests.companion.service_process import heartbeats, running_service

pytestmark = pytest.mark.realtime


GRAFANA = Path(__file__).parents[3] / "docs" / "grafana.json"


def fetch(port: int) -> dict[str, float]:
    """Return all metrics: name with its labels → value."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        lines = answer.read().decode().splitlines()
    pairs = (line.rpartition(" ") for line in lines if line and not line.startswith("#"))
    return {name: float(value) for name, _, value in pairs}


def test_metrics_and_tracks_of_a_running_service(seeing: list[str], tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    # An untrained network has low confidences; all its non-overlapping boxes are used.
    flags = [
        *(*seeing, "--metrics-listen", f"127.0.0.1:{port}", "--detector-rate-hz", "4"),
        *("--confidence", "0", "--detector-iou", "0.05", "--tracker-confirm-score", "0"),
        *("--classes", "person"),  # boxes of two classes at one place are not confirmed
    ]
    tracks: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    detections: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    with (
        heartbeats() as vehicle_port,
        running_service(vehicle_port, flags, cwd=tmp_path) as service,
        service.client() as session,
    ):
        listen(session, "tracks", lambda _key, text: tracks.put(json.loads(text)))
        listen(session, "detections", lambda _key, text: detections.put(json.loads(text)))
        message, frame = tracks.get(timeout=30), detections.get(timeout=30)
        while frame["sequence"] < message["sequence"]:
            frame = detections.get(timeout=30)
        while message["sequence"] < frame["sequence"]:
            message = tracks.get(timeout=30)
        service.wait_for_line("autopilot heartbeat received")
        numbers = fetch(port)
        while not numbers.get('companion_frames_skipped_total{camera="",reason="rate"}'):
            numbers = fetch(port)
    assert numbers["companion_vehicle_armed"] == 0
    # Every metric of the dashboard of Grafana is there.
    named = {
        re.search(r"companion_\w+", target["expr"])[0]  # type: ignore[index]
        for panel in json.loads(GRAFANA.read_text())["panels"]
        for target in panel["targets"]
    }
    assert len(named) > 10
    assert named <= {name.partition("{")[0] for name in numbers}
    assert numbers['companion_perception_running{camera=""}'] == 1
    assert numbers['companion_messages_published_total{topic="detections"}'] > 0
    for stage in ("capture", "decode", "wait", "preprocess", "inference", "postprocess", "track", "publish"):
        quantiles = [
            numbers[f'companion_stage_milliseconds{{camera="",quantile="{q}",stage="{stage}"}}']
            for q in ("0.5", "0.99")
        ]
        assert 0 <= quantiles[0] <= quantiles[1]
    with pytest.raises(OSError, match="refused"):
        fetch(port)
    assert message["captured_ns"] == frame["captured_ns"]
    assert message["vehicle"] == "vehicle1"
    assert message["camera"] is None
    updates = {e["track_id"] for e in message["events"] if e["event"] in ("new", "update")}
    assert updates
    assert updates == {f["track_id"] for f in frame["detections"] if f["track_state"] == "confirmed"}
    assert frame["timing_ms"]["track"] >= 0


def test_metrics_are_empty_before_the_first_status() -> None:
    server = MetricsServer("127.0.0.1:0", lambda: None)
    port = server.port
    assert fetch(port) == {}
    server.close()
    MetricsServer(f"127.0.0.1:{port}", lambda: None).close()


def test_busy_metrics_address_is_reported() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        where = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(AddressTakenError, match=f"{where}: .*in use"):
            MetricsServer(where, lambda: None)


def test_missing_library_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(MetricsError, match=r"companion\[service\]"):
        MetricsServer("127.0.0.1:0", lambda: None)


def test_stalled_scraper_does_not_block_others() -> None:
    server = MetricsServer("127.0.0.1:0", lambda: None)
    with (
        socket.create_connection(("127.0.0.1", server.port)),  # sends nothing
        socket.create_connection(("127.0.0.1", server.port)) as stalled,
    ):
        stalled.sendall(b"GET /metrics HTTP/1.1\r\nHost: here\r\n\r\n" * 100)
        assert fetch(server.port) == {}
        closing = threading.Thread(target=server.close)
        closing.start()
        closing.join(5.0)
        assert not closing.is_alive()


def test_scrape_is_answered_while_others_hold_connections() -> None:
    server = MetricsServer("127.0.0.1:0", lambda: None)
    held: list[socket.socket] = []
    try:
        before = threading.active_count()
        for _ in range(200):
            held.append(socket.create_connection(("127.0.0.1", server.port)))
            held[-1].sendall(b"GET / HT")
        fetch(server.port)
        while threading.active_count() > before + 2 * MAX_CONNECTIONS:
            fetch(server.port)  # those that were closed are ending
    finally:
        for connection in held:
            connection.close()
        server.close()
