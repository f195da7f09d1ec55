"""The beginning and the end of the clients that the service starts: `python -m PACKAGE`, options as JSON.

Such a client ends with its parent. It prints lines for the operator, of which those with the beginnings below
say whether it works.
"""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from threading import Event, Thread
from typing import Any

from zenoh import Session

from companion.bus.client import NoAnswerError, open_client, settings_in_child
from companion.bus.config import BusError
from companion.host.child_process import EXIT_REFUSED, on_parent_end, read_options
from companion.host.passing import EXIT_PASSING, PassingError
from companion.settings import ZenohSection
from vision.extras import missing_module

LISTENING, PAUSED = "open ", "paused: "
"""Beginnings of a line: it works; it does not now, and why."""

_RETRY_S = 2.0


@dataclass(frozen=True, slots=True)
class ChildClient:
    """What such a client is given.

    Attributes:
        zenoh: settings of a client of the service's bus.
        options: the others, of its package.
        ending: set when it is to end, from a thread.
    """

    zenoh: ZenohSection
    options: dict[str, Any]
    ending: Event = field(default_factory=Event)

    def say(self, text: str) -> None:
        """Print a line, from any thread."""
        print(text, flush=True)

    async def ended(self) -> None:
        """Wait in an asyncio loop until it is to end."""
        loop, ended = asyncio.get_running_loop(), asyncio.Event()

        def wait() -> None:
            self.ending.wait()
            with suppress(RuntimeError):  # the loop has ended before
                loop.call_soon_threadsafe(ended.set)

        Thread(target=wait, name="ending", daemon=True).start()
        await ended.wait()

    @contextmanager
    def open_bus(self) -> Iterator[Session | None]:
        """Open the service's bus, however late it comes; None: it was to end before."""
        with open_patiently(self.zenoh, self.ending, self.say) as session:
            yield session


@contextmanager
def open_patiently(
    section: ZenohSection, ending: Event, say: Callable[[str], None], missing: str = ""
) -> Iterator[Session | None]:
    """Open a session that is connected to a node, however late that comes; None: `ending` was set before.

    Args:
        missing: why there is none, for people; empty: as `open_client` says it.
    """
    session, said = None, False
    with ExitStack() as stack:
        while session is None and not ending.is_set():
            try:
                session = stack.enter_context(open_client(section, timeout_s=0.0))
            except NoAnswerError as error:
                if not said:
                    say(f"{PAUSED}{missing or error}; retrying")
                said = True
                ending.wait(_RETRY_S)
        yield session


def run_child(work: Callable[[ChildClient], None], refused: tuple[type[Exception], ...] = ()) -> int:
    """Run such a client until its end; returns the exit code of its process.

    Args:
        refused: errors, beside those of the bus and of missing packages, that another start would meet again.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, as a closed terminal is
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    options = json.loads(read_options())
    client = ChildClient(settings_in_child(options.pop("zenoh")), options)
    on_parent_end(client.ending.set)
    refused = (BusError, *refused)
    try:
        work(client)
    except ModuleNotFoundError as error:
        client.say(missing_module(error) or str(error))
        return EXIT_REFUSED
    except (PassingError, NoAnswerError) as error:  # or the node has gone since
        client.say(str(error))
        return EXIT_PASSING
    except refused as error:
        client.say(str(error))
        return EXIT_REFUSED
    return 0
