"""An endless command of a real service: bus, client and page read the same end."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from companion import connect
from companion.bus.client import listen
from mavlink_sim.testing import QUICK_FLIGHT, running_simulator
from tests.companion.dashboard.page_module import evaluate
from tests.companion.dashboard.serving import EventStream, serving
from tests.companion.dashboard.test_outcome import SHOWN
from tests.companion.service_process import ServiceProcess, running_service
from tests.programs import NODE

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]


async def page_messages(stream: EventStream, identifier: str) -> list[dict[str, Any]]:
    """What the page gets of a command, until its end."""
    found: list[dict[str, Any]] = []
    while not found or found[-1]["state"] != "ended":
        news = await stream.next()
        assert news is not None
        found += [one for one in news["command_states"] if one["id"] == identifier]
    return found


async def ends_of_a_hold(service: ServiceProcess, bus: list[dict[str, Any]]) -> None:
    async with connect(service.endpoint) as drone, serving(service.endpoint) as port:
        reply = await drone.hold()
        assert reply["state"] == "in_progress"
        assert drone.ending(reply) is None
        async for status in drone.status():
            if status["pilot"]["command"] == {"id": reply["id"], "command": "hold"}:
                break
        await drone.land()
        ended = await asyncio.wait_for(drone.ended(reply), 20.0)
        assert (ended["success"], ended["reason"]) == (False, "replaced by land")
        stream = await EventStream.open(port)  # a late one: it gets what is kept
        states = await asyncio.wait_for(page_messages(stream, reply["id"]), 20.0)
        stream.close()
    own = [one for one in bus if one["id"] == reply["id"]]
    assert own == states
    assert [one["state"] for one in own] == ["accepted", "in_progress", "ended"]
    assert own[-1] == ended
    if NODE is not None:
        given = {"reply": {**reply, "command_id": reply["id"]}, "messages": states, "service": None}
        assert evaluate("outcome.js", SHOWN, given) == ["ended: replaced by land", "ended"]


def test_end_is_the_same_on_bus_client_and_page(tmp_path: Path) -> None:
    with (
        running_simulator(ready_after=0.0, parameters=QUICK_FLIGHT) as simulator,
        running_service(simulator.onboard_port, ("--source", "none"), cwd=tmp_path) as service,
        service.client() as session,
    ):
        bus: list[dict[str, Any]] = []
        subscriber = listen(session, "command_state", lambda _key, text: bus.append(json.loads(text)))
        service.take_off(2.5)
        asyncio.run(ends_of_a_hold(service, bus))
        subscriber.undeclare()  # type: ignore[no-untyped-call]
