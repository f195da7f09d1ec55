"""The connection to zenoh, a bridge for each vehicle that is alive, and their commands.

Without a visible page only the vehicles' presence is subscribed. At most `MAX_VEHICLES` are kept.
"""

from __future__ import annotations

import asyncio
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

from companion.bus.bodies.vehicle import VelocityBody
from companion.bus.client import NoAnswerError, no_node_text, send_command
from companion.bus.command_order import CommandOrder, is_stop
from companion.bus.connection_fault import connection_fault
from companion.bus.session import encode, zenoh_config
from companion.bus.topics import VELOCITY, alive_key
from companion.dashboard.bridge import Bridge, Link
from companion.dashboard.merge import SeenObject, merged
from companion.geometry.geodesy import north_east
from companion.settings import ZenohSection

MAX_VEHICLES = 32
MAX_COMMANDS = 32
"""Commands of one vehicle that wait for their outcome; `stop` has a separate allowance of the same size."""
_PERIOD_S = 0.5
_LIST_TIMEOUT_S, _STOP_WAIT_S = 1.0, 5.0
_KEPT_REPLIES = 50
_COMMAND_TIMEOUT_S, _STOP_TIMEOUT_S = 3600.0, 10.0


class Fleet:
    """The vehicles on the bus.

    Args:
        settings: of a zenoh client.
        vehicle: name of the vehicle that is shown first.

    Attributes:
        order: of all commands that are sent by this session.
    """

    def __init__(self, settings: ZenohSection, vehicle: str) -> None:
        self._settings = settings
        self._link = Link()
        self.first = Bridge(self._link, vehicle)
        self._bridges = {vehicle: self.first}
        self._watched: dict[str, int] = {}
        self._subscribers: list[Any] = []
        # With their numbers in the order of arrival.
        self._replies: deque[tuple[int, dict[str, Any]]] = deque(maxlen=_KEPT_REPLIES)
        self._number = 0
        self._waiting: Counter[tuple[str, bool]] = Counter()  # by vehicle, and whether it is `stop`
        self.order = CommandOrder()
        self._objects: list[SeenObject] = []

    @property
    def problem(self) -> str:
        """Why there is no connection to zenoh; empty if there is one."""
        return self._link.problem

    @property
    def session(self) -> zenoh.Session | None:
        """The connection to zenoh; None while there is none."""
        return self._link.session

    def on_command(self, call: Callable[[str], None]) -> None:
        """Set what is called with a vehicle's name when its events, while subscribed, show a command."""
        self._link.on_command = call

    async def run(self) -> None:
        """Connect, merge what the vehicles see, end what nobody watches any more; until cancelled."""
        self._link.loop = asyncio.get_running_loop()
        try:
            while True:
                if self._link.session is None:
                    await self._connect()
                else:
                    self._watch_link(self._link.session)
                    for bridge in self._bridges.values():
                        bridge.end_leases()
                # In a thread: for many tracks it takes longer than a stop command may wait.
                seen = [one for bridge in self._bridges.values() for one in bridge.sightings()]
                self._objects = await asyncio.to_thread(merged, seen)
                await asyncio.sleep(_PERIOD_S)
        finally:
            session, self._link.session = self._link.session, None
            if session is not None:
                await asyncio.to_thread(session.close)

    def bridge(self, vehicle: str) -> Bridge | None:
        """Return the bridge of a vehicle; None for one more than `MAX_VEHICLES`. ``""`` is the first one."""
        if not vehicle:
            return self.first
        if vehicle not in self._bridges:
            for name, bridge in list(self._bridges.items()):
                unused = bridge is not self.first and not bridge.alive and name not in self._watched
                if unused and len(self._bridges) >= MAX_VEHICLES:
                    bridge.close()
                    del self._bridges[name]
            if len(self._bridges) >= MAX_VEHICLES:
                return None
            self._bridges[vehicle] = Bridge(self._link, vehicle)
            if self._watched:
                self._bridges[vehicle].subscribe()
        return self._bridges[vehicle]

    @contextmanager
    def watching(self, bridge: Bridge) -> Iterator[None]:
        """Subscribe to the state of all vehicles meanwhile, for a page that shows one of them."""
        self._bridges.setdefault(bridge.vehicle, bridge)
        self._watched[bridge.vehicle] = self._watched.get(bridge.vehicle, 0) + 1
        self._subscribe()
        try:
            yield
        finally:
            self._watched[bridge.vehicle] -= 1
            if not self._watched[bridge.vehicle]:
                del self._watched[bridge.vehicle]
            if not self._watched:
                for other in self._bridges.values():
                    other.unsubscribe()

    def vehicles(self, shown: Bridge) -> list[dict[str, Any]]:
        """Return the vehicles that are alive, and the one that is shown, by name.

        `at_ned_m`: north and east in local NED of the one that is shown; None while a position is unknown.
        `own_ned_m`: the same in its own local NED.
        """
        return [
            {
                "name": name,
                "alive": bridge.alive,
                "state_age_s": None if (age_s := bridge.state_age_s()) is None else round(age_s, 1),
                "mode": bridge.state.get("mode"),
                "armed": bridge.state.get("armed"),
                "altitude_m": bridge.state.get("altitude_m"),
                "yaw_rad": bridge.state.get("yaw_rad"),
                "at_ned_m": _local(
                    shown.state, bridge.state.get("latitude_deg"), bridge.state.get("longitude_deg")
                ),
                "own_ned_m": _local(
                    bridge.state, bridge.state.get("latitude_deg"), bridge.state.get("longitude_deg")
                ),
            }
            for name, bridge in sorted(self._bridges.items())
            if bridge.alive or bridge is shown
        ]

    def objects(self, shown: Bridge) -> list[dict[str, Any]]:
        """Return what the vehicles see, once each; `at_ned_m` as in `vehicles`."""
        return [
            {
                "class_name": seen.class_name,
                "at_ned_m": _local(shown.state, seen.latitude_deg, seen.longitude_deg),
                "tracks": [[one.vehicle, one.track_id] for one in seen.sightings],
            }
            for seen in self._objects
        ]

    def replies(self, after: int) -> tuple[int, list[dict[str, Any]]]:
        """Return the number of the newest outcome of a command, and those after a number."""
        return self._number, [reply for number, reply in self._replies if number > after]

    def command(self, vehicle: str, text: str, identifier: str) -> asyncio.Future[dict[str, Any]] | None:
        """Send a command; the outcome is also added to `replies`. None: too many are waiting.

        A vehicle's commands are sent in the order of the calls, `stop` at once (`CommandOrder`).
        """
        loop = self._link.loop
        assert loop is not None
        stop = is_stop(text)
        if self._waiting[vehicle, stop] >= MAX_COMMANDS:
            return None
        self._waiting[vehicle, stop] += 1
        turn = self.order.turn(vehicle, text)
        outcome: asyncio.Future[dict[str, Any]] = loop.create_future()
        about = {"id": identifier, "command": text[:200], "vehicle": vehicle}

        def finish(reply: dict[str, Any]) -> None:
            self._waiting[vehicle, stop] -= 1
            answer = {**reply, "command_id": reply.get("id"), **about}
            self._number += 1
            self._replies.append((self._number, answer))
            outcome.set_result(answer)

        def send() -> None:
            timeout_s = _STOP_TIMEOUT_S if stop else _COMMAND_TIMEOUT_S
            try:
                with turn:
                    session = self._link.session
                    if session is None:
                        raise NoAnswerError(self.problem)
                    reply = send_command(session, vehicle, text, timeout_s=timeout_s, turn=turn)
            except (NoAnswerError, ValueError, zenoh.ZError) as error:
                reply = {"success": False, "reason": str(error).partition("\n")[0]}
            if not loop.is_closed():
                loop.call_soon_threadsafe(finish, reply)

        # A thread each: a pool would let endless commands delay a stop.
        threading.Thread(target=send, daemon=True).start()
        return outcome

    def steer(self, vehicle: str, body: VelocityBody) -> bool:
        """Publish a velocity for a vehicle; False: there is no connection to zenoh."""
        session = self._link.session
        if session is None:
            return False
        session.put(
            VELOCITY.key(vehicle),
            encode(body),
            encoding=VELOCITY.encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=VELOCITY.priority,
            express=VELOCITY.express,
        )
        return True

    async def stop_all(self, identifier: str) -> dict[str, Any]:
        """Send `stop` to every vehicle that is alive; returns one outcome, of at most `_STOP_WAIT_S`."""
        names = [name for name, bridge in self._bridges.items() if bridge.alive]
        sent = {name: self.command(name, "stop", "") for name in names}
        for name in await asyncio.to_thread(self._listed):
            if name not in sent:
                sent[name] = self.command(name, "stop", "")
        waiting = [outcome for outcome in sent.values() if outcome is not None]
        if waiting:
            await asyncio.wait(waiting, timeout=_STOP_WAIT_S)
        replies = {
            name: outcome.result()
            if outcome is not None and outcome.done()
            else {
                "success": False,
                "reason": "too many commands are waiting" if outcome is None else "no answer",
            }
            for name, outcome in sorted(sent.items())
        }
        return {
            "id": identifier,
            "command": "stop all",
            "vehicle": "*",
            "success": bool(replies) and all(reply["success"] for reply in replies.values()),
            "reason": "; ".join(f"{name}: {reply['reason']}" for name, reply in replies.items())
            or self.problem
            or "no vehicle is alive",
        }

    def _listed(self) -> list[str]:
        """Ask zenoh for the vehicles that are alive."""
        session = self._link.session
        if session is None:
            return []
        replies = session.liveliness().get(alive_key("*"), timeout=_LIST_TIMEOUT_S)
        return [_vehicle_of(reply.ok) for reply in replies if reply.ok is not None]

    async def _connect(self) -> None:
        config = zenoh_config(self._settings)
        try:
            self._link.session = await asyncio.to_thread(zenoh.open, config)
        except zenoh.ZError:
            fault = await asyncio.to_thread(connection_fault, config)
            self._link.problem = fault or no_node_text(", ".join(self._settings.connect))
            return
        self._link.problem = ""
        self._subscribe()
        self._watch_presence(self._link.session)

    def _watch_link(self, session: zenoh.Session) -> None:
        """Note a lost connection; zenoh itself connects again."""
        linked = bool(list(session.info.routers_zid()) or list(session.info.peers_zid()))
        lost = f"connection to {', '.join(self._settings.connect)} lost, retrying"
        self._link.problem = "" if linked else lost

    def _subscribe(self) -> None:
        if self._watched:
            for bridge in self._bridges.values():
                bridge.subscribe()

    def _watch_presence(self, session: zenoh.Session) -> None:
        """Subscribe to the vehicles' presence for the whole session, so that a new page has all at once."""
        # The access control may allow the first vehicle only.
        for key in (alive_key(self.first.vehicle), alive_key("*")):
            self._subscribers.append(
                session.liveliness().declare_subscriber(key, self._on_alive, history=True)
            )

    def _on_alive(self, sample: zenoh.Sample) -> None:
        """Runs on a zenoh thread."""
        name, alive = _vehicle_of(sample), sample.kind == zenoh.SampleKind.PUT
        loop = self._link.loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._set_alive, name, alive)

    def _set_alive(self, name: str, alive: bool) -> None:
        bridge = self.bridge(name) if alive else self._bridges.get(name)
        if bridge is not None:
            bridge.set_alive(alive)


def _vehicle_of(sample: zenoh.Sample) -> str:
    return str(sample.key_expr).split("/")[1]


def _local(shown: dict[str, Any], latitude_deg: Any, longitude_deg: Any) -> list[float] | None:
    """Return metres north and east in local NED of a vehicle whose state is given; None if unknown."""
    try:
        here = float(shown["latitude_deg"]), float(shown["longitude_deg"])
        north_m, east_m = north_east(here, (float(latitude_deg), float(longitude_deg)))
        own = shown["position_ned_m"]
        return [round(own[0] + north_m, 2), round(own[1] + east_m, 2)]
    except (KeyError, TypeError, ValueError, IndexError):
        return None
