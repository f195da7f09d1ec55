"""Faults over zenoh: a queryable at `mavlink_sim/<system id>/fault` that takes the grammar.

The text is the query's payload or its parameter `fault` (`mavlink_sim/1/fault?fault=link_delay 0.2`). The
reply is JSON: `{"ok": true, "text": "fault 1 link_delay 0.2", "active": ["1 link_delay 0.2: since 12.3 s"]}`.

zenoh calls on its own threads; queries are queued until the simulator's loop polls. The session listens only
at the given endpoint, connects to no other and has no multicast scouting.
"""

from __future__ import annotations

import json
import logging
import queue
from typing import Any

from mavlink_sim.faults.schedule import Faults

logger = logging.getLogger(__name__)

LONGEST_COMMAND_BYTES = 4096
MAX_WAITING = 100


class ControlError(OSError):
    """The control endpoint cannot be opened. The message is one line for the user."""


def fault_key(system_id: int) -> str:
    """The key of a vehicle's faults."""
    return f"mavlink_sim/{system_id}/fault"


class FaultControl:
    """The queryable of one vehicle.

    Args:
        endpoint: where zenoh listens, for example `tcp/127.0.0.1:7447`.

    Raises:
        ControlError: zenoh is not installed, or cannot listen there.
    """

    def __init__(self, endpoint: str, system_id: int, faults: Faults) -> None:
        try:
            import zenoh  # imported on demand: it is slow
        except ImportError as error:
            raise ControlError("--control needs zenoh: pip install eclipse-zenoh") from error
        self._faults = faults
        self._waiting: queue.Queue[Any] = queue.Queue(MAX_WAITING)
        self._endpoint = endpoint
        try:
            self._session = _shared_session(endpoint)
        except zenoh.ZError as error:
            reason = str(error).splitlines()[0]
            raise ControlError(f"--control {endpoint}: zenoh cannot listen there: {reason}") from error
        self.key = fault_key(system_id)
        self._queryable = self._session.declare_queryable(self.key, self._query)

    def _query(self, query: Any) -> None:
        """Called on a thread of zenoh."""
        try:
            self._waiting.put_nowait(query)
        except queue.Full:
            logger.warning("%s: more than %d queries are queued; one is dropped", self.key, MAX_WAITING)

    def poll(self) -> None:
        """Execute and answer the queued queries."""
        while True:
            try:
                query = self._waiting.get_nowait()
            except queue.Empty:
                return
            self._answer(query)

    def _answer(self, query: Any) -> None:
        payload = query.payload
        data = payload.to_bytes() if payload is not None else b""
        text = data[:LONGEST_COMMAND_BYTES].decode(errors="replace")
        if not text:
            text = query.parameters.get("fault", "")
        outcome = self._faults.command(text)
        active = [line for line in self._faults.listing() if line != "no faults"]
        reply = {"ok": outcome.ok, "text": outcome.text, "active": active}
        query.reply(self.key, json.dumps(reply).encode(), encoding="application/json")

    def close(self) -> None:
        """Stop answering; the last vehicle in this process closes the session."""
        self._queryable.undeclare()
        session, users = _sessions[self._endpoint]
        if users > 1:
            _sessions[self._endpoint] = (session, users - 1)
            return
        del _sessions[self._endpoint]
        session.close()


# The vehicles of one process share the session of an endpoint: (session, how many use it).
_sessions: dict[str, tuple[Any, int]] = {}


def _shared_session(endpoint: str) -> Any:
    """A session that listens only at the endpoint. Raises zenoh.ZError."""
    import zenoh

    session, users = _sessions.get(endpoint, (None, 0))
    if session is None:
        settings = {
            "mode": "peer",
            "listen/endpoints": [endpoint],
            "connect/endpoints": [],
            "scouting/multicast/enabled": False,
        }
        config = zenoh.Config()
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        session = zenoh.open(config)
    _sessions[endpoint] = (session, users + 1)
    return session
