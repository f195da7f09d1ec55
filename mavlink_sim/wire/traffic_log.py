"""The traffic of links as .tlog files."""

from __future__ import annotations

import logging
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

from mavlink_sim.wire.endpoint import UdpEndpoint

logger = logging.getLogger(__name__)

_STAMP = struct.Struct(">Q")


class TrafficLog:
    """An open tlog. `record` appends one packet; on a write error the file is closed with a warning."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._failed = False

    def record(self, packet: bytes) -> None:
        if self._failed:
            return
        try:
            self._file.write(_STAMP.pack(time.time_ns() // 1000) + packet)
        except OSError as error:
            self._failed = True
            logger.warning("the record %s ends here: %s", self._file.name, error)


@contextmanager
def recording(endpoints: Mapping[str, UdpEndpoint], folder: Path) -> Iterator[None]:
    """Record what every endpoint sends and receives into `folder/<its name>.tlog`.

    Raises OSError if the folder or a file in it cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        for name, endpoint in endpoints.items():
            file = stack.enter_context((folder / f"{name}.tlog").open("wb", buffering=0))
            endpoint.on_packet = TrafficLog(file).record
            stack.callback(setattr, endpoint, "on_packet", None)
        yield
