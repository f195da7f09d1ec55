"""The dashboard as a child process of the service, of the demonstration or of `companion play`."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from companion.bus.client import NoAnswerError, settings_for_child
from companion.bus.config import BusError
from companion.host.child_process import child_process
from companion.settings import Settings


@asynccontextmanager
async def dashboard_process(settings: Settings, say: Callable[[str], None]) -> AsyncIterator[None]:
    """Run the page meanwhile, if `dashboard.listen` is set. Nothing else depends on it.

    Args:
        say: called in the loop with the page's address, or with one line why there is none.
    """
    if not settings.dashboard.listen:
        yield
        return
    try:
        zenoh = settings_for_child(settings.zenoh)
    except (NoAnswerError, BusError) as error:
        say(f"dashboard: {error}")
        yield
        return
    options = {
        "listen": settings.dashboard.listen,
        "token_file": settings.dashboard.token_file,
        "zenoh": zenoh,
        "vehicle": settings.vehicle.name,
        "language": settings.language.model_dump(mode="json"),
        "plugins": settings.plugins.modules,
        "hosts": settings.dashboard.hosts,
    }
    async with child_process("dashboard", "companion.dashboard", json.dumps(options), say):
        yield
