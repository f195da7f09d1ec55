"""MAVSDK 4 as a client of a vehicle: connected, and destroyed in an order without crashes.

A plugin of MAVSDK is destroyed with its last reference, possibly on a thread of the pool in which a call was
made; while another thread destroys the library, that ends the process. Callbacks are freed before the calling
thread has ended. So plugins and callbacks are kept until the library is destroyed.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine
from contextlib import aclosing, asynccontextmanager, suppress
from typing import Any, TypeVar

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk

Plugin = TypeVar("Plugin")
LIMIT_S = 80.0


class MavsdkClient:
    """An autopilot that MAVSDK found."""

    def __init__(self, system: Any) -> None:
        self._system = system
        self._plugins: list[Any] = []

    def plugin(self, kind: Callable[[Any], Plugin]) -> Plugin:
        """One of MAVSDK's plugins, e.g. `ActionAsync`, for this autopilot."""
        made = kind(self._system)
        self._plugins.append(made)
        return made

    def trampolines(self) -> list[Any]:
        """The callbacks of all plugins: copies, as a plugin clears its own when it is destroyed."""
        inner = [plugin._plugin for plugin in self._plugins]
        return [
            [*getattr(one, "_callbacks", ()), *getattr(one, "_subscriptions", {}).values()] for one in inner
        ]


@asynccontextmanager
async def mavsdk_client(
    url: str, component_type: ComponentType = ComponentType.GROUND_STATION
) -> AsyncIterator[MavsdkClient]:
    """MAVSDK, connected to the first autopilot that it finds at `url`."""
    library = Mavsdk(Configuration.create_with_component_type(component_type))
    held: list[Any] = []
    try:
        await library.add_any_connection(url)
        system = await library.first_autopilot(20.0)
        assert system is not None, f"MAVSDK found no autopilot at {url} within 20 s"
        client = MavsdkClient(system)
        try:
            yield client
        finally:
            held = client.trampolines()
    finally:
        library.destroy()
        held.clear()


@asynccontextmanager
async def meanwhile(work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    """Run this in the background; it is cancelled at the end. Raises what it raised."""
    task = asyncio.create_task(work)
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def wait_for(
    updates: AsyncGenerator[Any, None], condition: Callable[[Any], bool] = lambda _: True
) -> Any:
    """The first update of a subscription that meets the condition."""
    async with aclosing(updates), asyncio.timeout(LIMIT_S):
        async for update in updates:
            if condition(update):
                return update
    raise AssertionError("the stream of updates ended")
