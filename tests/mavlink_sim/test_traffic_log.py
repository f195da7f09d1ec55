"""The record of a link's traffic."""

from __future__ import annotations

import logging
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from mavlink_sim.wire.endpoint import UdpEndpoint
from mavlink_sim.wire.messages import Outgoing, dialect, parser
from mavlink_sim.wire.traffic_log import TrafficLog, recording

pytestmark = pytest.mark.realtime


def read(path: Path) -> list[Any]:
    log = mavutil.mavlink_connection(str(path))
    found = []
    while (message := log.recv_match()) is not None:
        found.append(message)
    log.close()
    return found


def test_both_directions_are_recorded_with_the_time_of_day(tmp_path: Path) -> None:
    endpoint = UdpEndpoint("127.0.0.1", 0, 9)
    before = time.time()
    with recording({"onboard": endpoint}, tmp_path / "new" / "folder"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
            peer.sendto(beat.pack(parser(1, 191)), ("127.0.0.1", endpoint.port))
            deadline = time.monotonic() + 10.0
            while not endpoint.receive():
                assert time.monotonic() < deadline
        endpoint.send([Outgoing(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3), 1, 1)])
    endpoint.send([Outgoing(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3), 1, 1)])  # not any more
    endpoint.close()
    messages = read(tmp_path / "new" / "folder" / "onboard.tlog")
    assert [(m.get_type(), m.get_srcComponent()) for m in messages] == [("HEARTBEAT", 191), ("HEARTBEAT", 1)]
    assert before - 1.0 <= messages[0]._timestamp <= messages[1]._timestamp <= time.time() + 1.0


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"), recording({}, tmp_path / "file" / "folder"):
        pass


def test_full_disk_ends_record_not_flight(caplog: pytest.LogCaptureFixture) -> None:
    with open("/dev/full", "wb", buffering=0) as full, caplog.at_level(logging.WARNING):
        log = TrafficLog(full)
        log.record(b"packet")
        log.record(b"packet")
    assert len(caplog.records) == 1
    assert "/dev/full" in caplog.text
