"""A zenoh router in a process of its own, which can be killed."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

import zenoh

_START_S = 30.0


def _route(port: int, ready: Connection) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        ready.send(True)
        ready.recv()


@contextmanager
def router(port: int) -> Iterator[multiprocessing.process.BaseProcess]:
    """Run a router on a port of this computer meanwhile."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_route, args=(port, theirs), daemon=True)
    process.start()
    try:
        assert ours.poll(_START_S), "the router did not start"
        ours.recv()
        yield process
    finally:
        process.kill()
        process.join()
        ours.close()
