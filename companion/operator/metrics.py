"""The service's status as Prometheus metrics: `GET /metrics` on a configured address.

Served in threads of its own, from the last published status, so that a scraper never blocks the guidance
loop.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from companion.host.passing import AddressTakenError
from vision.extras import install_command

if TYPE_CHECKING:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

Status = Mapping[str, Any]


class MetricsError(RuntimeError):
    """The endpoint cannot be opened. The message is one line."""


class MetricsServer:
    """Serves `/metrics` until it is closed.

    Args:
        listen: HOST:PORT; port 0 for a free one.
        snapshot: returns the newest status (`Service.status`), None before the first; called in the server's
            thread.

    Raises:
        MetricsError: the library is not installed. AddressTakenError: the address is not available.
    """

    def __init__(self, listen: str, snapshot: Callable[[], Status | None]) -> None:
        try:
            from prometheus_client import CollectorRegistry, make_wsgi_app

            # With http.client it takes longer to import than the rest here.
            from companion.operator.wsgi_server import open_server
        except ImportError as error:
            raise MetricsError(
                f"metrics.listen needs prometheus_client: {install_command('prometheus_client')}"
            ) from error
        host, _, port = listen.rpartition(":")
        registry = CollectorRegistry()
        registry.register(_Collector(snapshot))
        try:
            self._server = open_server(host, int(port), make_wsgi_app(registry))
        except (OSError, OverflowError) as error:
            raise AddressTakenError(f"metrics cannot be served on {listen}: {error}") from error
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The TCP port of the server."""
        return int(self._server.server_port)

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Collector:
    def __init__(self, snapshot: Callable[[], Status | None]) -> None:
        self._snapshot = snapshot

    def collect(self) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
        status = self._snapshot()
        if status is None:
            return
        yield from _of_service(status)
        yield from _of_cameras({"": status["perception"], **status["cameras"]})


def _of_service(status: Status) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    vehicle, pilot, bus = status["vehicle"], status["pilot"], status["bus"]
    for name, meaning, value in (
        ("healthy", "1 while every part works", status["healthy"]),
        ("uptime_seconds", "time since the service's start", status["uptime_s"]),
        ("vehicle_connected", "1 while autopilot heartbeats are received", vehicle["connected"]),
        ("vehicle_armed", "1 while the vehicle is armed", vehicle["armed"]),
        ("vehicle_failsafe", "1 while the autopilot is in a failsafe", vehicle["failsafe"]),
        ("in_command", "1 while the service commands the vehicle", pilot["in_command"]),
        ("bus_connected", "1 while zenoh's endpoints are connected", bus["connected"]),
    ):
        yield GaugeMetricFamily(f"companion_{name}", meaning, value=float(value or 0))
    yield CounterMetricFamily(
        "companion_setpoints_sent", "setpoints sent to the autopilot", value=float(pilot["setpoints_sent"])
    )
    published = CounterMetricFamily(
        "companion_messages_published", "messages passed to zenoh", labels=["topic"]
    )
    for topic, count in bus["published"].items():
        published.add_metric([topic], float(count))
    yield published
    yield CounterMetricFamily(
        "companion_log_lines_dropped",
        "log lines dropped because the output was not read",
        value=float(status["log"]["dropped_lines"]),
    )
    yield GaugeMetricFamily(
        "companion_other_commanders",
        "other services on the same vehicle",
        value=float(len(vehicle["other_commanders"])),
    )
    yield CounterMetricFamily(
        "companion_publish_failed", "messages that were not published", value=float(bus["publish_failed"])
    )


def _of_cameras(cameras: dict[str, Status]) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    for key, name, meaning in (
        ("frames", "frames_read", "frames read from the source"),
        ("results", "results", "results received by the service"),
        ("restarts", "perception_restarts", "perception processes replaced"),
    ):
        counter = CounterMetricFamily(f"companion_{name}", meaning, labels=["camera"])
        for camera, state in cameras.items():
            counter.add_metric([camera], float(state[key]))
        yield counter
    frames_skipped = CounterMetricFamily(
        "companion_frames_skipped", "frames without a published result", labels=["camera", "reason"]
    )
    frames_repeated = CounterMetricFamily(
        "companion_frames_repeated", "frames identical to the one before", labels=["camera", "kind"]
    )
    stages = GaugeMetricFamily(
        "companion_stage_milliseconds",
        "duration of one stage, newest 200 results",
        labels=["camera", "stage", "quantile"],
    )
    age = GaugeMetricFamily(
        "companion_newest_result_age_seconds", "time since its capture", labels=["camera"]
    )
    rate = GaugeMetricFamily("companion_results_per_second", "over the last two seconds", labels=["camera"])
    running = GaugeMetricFamily("companion_perception_running", "1 while its process runs", labels=["camera"])
    for camera, state in cameras.items():
        for reason, count in state["frames_skipped"].items():
            frames_skipped.add_metric([camera, reason], float(count))
        for kind, count in state["frames_repeated"].items():
            frames_repeated.add_metric([camera, kind], float(count))
        for quantile, key in (("0.5", "timing_p50_ms"), ("0.99", "timing_p99_ms")):
            for stage, value in state[key].items():
                stages.add_metric([camera, stage, quantile], float(value))
        if state["age_s"] is not None:
            age.add_metric([camera], float(state["age_s"]))
        rate.add_metric([camera], float(state["rate_hz"]))
        running.add_metric([camera], float(state["state"] == "running"))
    yield from (frames_skipped, frames_repeated, stages, age, rate, running)
