"""A console's connection to a running service, over zenoh."""

from __future__ import annotations

import asyncio

import pytest

from companion.bus.client import client_settings, open_client
from companion.client.attached import attached_target
from companion.settings import ZenohSection
from tests.companion.cli.test_only_vehicle import services

pytestmark = pytest.mark.realtime


async def test_lines_that_come_at_once_arrive_in_their_order() -> None:
    # As of a text with newlines that is pasted, or of keys that a slow network delivers together.
    lines = [f"goto {number} 0" for number in range(8)]
    with services("hawk") as (endpoint, received):
        section = client_settings(ZenohSection(connect=(endpoint,), multicast_scouting=False))
        with open_client(section, timeout_s=10.0) as session:
            target = attached_target(session, "hawk", print)
            for _ in range(5):
                received.clear()
                await asyncio.gather(*map(target.command, lines))
                assert [text for _, text in received] == lines
                received.clear()
                replies = await asyncio.gather(*map(target.command, [*lines, "stop"]))
                sent = [text for text, reply in zip(lines, replies, strict=False) if reply["success"]]
                assert [text for _, text in received] == [*sent, "stop"]
