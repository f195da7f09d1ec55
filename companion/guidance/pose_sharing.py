"""The vehicle's pose for the others, and theirs for it: published at 10 Hz, heard from the bus.

A pose is published only while the vehicle knows where on earth it is: who hears none counts it as silent.
"""

from __future__ import annotations

import json
import logging
import uuid
from collections.abc import Callable
from typing import Any

from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.formation import FormationBehaviour
from companion.guidance.formation.neighbours import Neighbourhood, Neighbours
from companion.guidance.formation.pose import Pose, PoseError, pose_from_message, pose_message, pose_of
from companion.vehicle.state import VehicleState

logger = logging.getLogger(__name__)


class PoseSharing:
    """One vehicle's part.

    Args:
        vehicle: its name. on_event: called with (level, text) for what a person should know.

    Attributes:
        vehicle: its name. source: of this run of the service, random.
        unread: messages that were no poses.
    """

    def __init__(self, vehicle: str, on_event: Callable[[str, str], None]) -> None:
        self.vehicle, self._on_event = vehicle, on_event
        self.source = uuid.uuid4().hex[:12]
        self._neighbours = Neighbours(vehicle, self.source)
        self.unread = 0

    def hear(self, payload: bytes, receipt_ns: int) -> None:
        """A message on anybody's `pose`, this vehicle's own too, that came at that time (CLOCK_MONOTONIC)."""
        try:
            pose = pose_from_message(json.loads(payload))
        except (PoseError, ValueError) as error:
            # Once is enough: it may come ten times a second.
            if not self.unread:
                self._on_event("warning", f"a pose on the network is not read: {error}")
            self.unread += 1
            return
        self.take(pose, receipt_ns)

    def take(self, pose: Pose, receipt_ns: int) -> None:
        """A pose that came at that time, CLOCK_MONOTONIC nanoseconds."""
        namesakes = len(self._neighbours.namesakes)
        self._neighbours.hear(pose, receipt_ns)
        if len(self._neighbours.namesakes) > namesakes:
            self._on_event(
                "error", f"another service calls its vehicle {self.vehicle} too: give each its vehicle.name"
            )

    def around(self, state: VehicleState, now_ns: int) -> Neighbourhood:
        """The other vehicles now."""
        return self._neighbours.around(state, now_ns)

    def pose(self, state: VehicleState, active: Behaviour | None, now_ns: int) -> Pose | None:
        """The pose to publish; None while the global position is unknown. `flown`: the active behaviour."""
        note = active.note if isinstance(active, FormationBehaviour) else None
        role = "follower" if note is not None else "alone"
        if note is None and self._neighbours.leads():
            role = "leader"
        return pose_of(state, now_ns, vehicle=self.vehicle, source=self.source, role=role, formation=note)

    def message(self, state: VehicleState, active: Behaviour | None, now_ns: int) -> dict[str, Any] | None:
        """The same as it is published."""
        pose = self.pose(state, active, now_ns)
        return None if pose is None else pose_message(pose)

    def status(self, now_ns: int) -> dict[str, Any]:
        """For `status`: how old what is known of each other vehicle is, seconds."""
        return {
            "ages_s": self._neighbours.ages_s(now_ns),
            "unread": self.unread,
            "out_of_order": self._neighbours.refused,
        }
