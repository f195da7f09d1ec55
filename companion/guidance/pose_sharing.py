"""Pose sharing: publish the vehicle's pose at 10 Hz, receive those of other vehicles.

A pose is published only while the global position is known; without one the others treat it as silent.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable

from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.formation import FormationBehaviour
from companion.guidance.formation.neighbours import Neighbourhood, Neighbours
from companion.guidance.formation.pose import Pose, Role, pose_from_message, pose_of
from companion.peer_data import parse_object
from companion.vehicle.state import VehicleState


class PoseSharing:
    """Pose sharing of one vehicle.

    Args:
        vehicle: its name. on_event: called with (level, text) for events.

    Attributes:
        vehicle: its name. source: random identifier of this run of the service.
        received: a pose of another vehicle was received, at any time.
    """

    def __init__(self, vehicle: str, on_event: Callable[[str, str], None]) -> None:
        self.vehicle, self._on_event = vehicle, on_event
        self.source = uuid.uuid4().hex[:12]
        self._neighbours = Neighbours(vehicle, self.source)
        self._valid_from_ns, self.received = 0, False

    def discard_received(self, now_ns: int) -> None:
        """What was received until now is outdated, also where it is processed later."""
        self._valid_from_ns = now_ns
        self._neighbours.discard_received()

    def on_message(self, payload: bytes, receipt_ns: int) -> None:
        """Handle a message on any vehicle's `pose` topic, received at that time (CLOCK_MONOTONIC ns).

        Raises:
            PoseError: the message is not valid.
        """
        if receipt_ns >= self._valid_from_ns:
            self.ingest(pose_from_message(parse_object(payload)), receipt_ns)

    def ingest(self, pose: Pose, receipt_ns: int) -> None:
        """Handle a pose received at that time, CLOCK_MONOTONIC nanoseconds."""
        self.received = self.received or pose.source != self.source
        namesakes = len(self._neighbours.namesakes)
        self._neighbours.ingest(pose, receipt_ns)
        if len(self._neighbours.namesakes) > namesakes:
            self._on_event(
                "error", f"duplicate vehicle.name {self.vehicle!r} on the network: give each service its own"
            )

    def neighbourhood(self, state: VehicleState, now_ns: int) -> Neighbourhood:
        """The other vehicles now."""
        return self._neighbours.neighbourhood(state, now_ns)

    def pose(
        self, state: VehicleState, active: Behaviour | None, now_ns: int, *, in_command: bool
    ) -> Pose | None:
        """The pose to publish; None while the global position is unknown.

        Args:
            active: the active behaviour. in_command: whether guidance is in command of the vehicle.
        """
        note = active.note if isinstance(active, FormationBehaviour) else None
        role: Role = "follower" if note is not None else "alone"
        if note is None and self._neighbours.leads():
            role = "leader"
        return pose_of(
            state,
            now_ns,
            vehicle=self.vehicle,
            source=self.source,
            role=role,
            formation=note,
            in_command=in_command,
        )

    def ages_s(self, now_ns: int) -> dict[str, float]:
        """Age of each other vehicle's pose, seconds."""
        return self._neighbours.ages_s(now_ns)

    @property
    def out_of_order(self) -> int:
        """Count of messages older than the newest one."""
        return self._neighbours.refused
