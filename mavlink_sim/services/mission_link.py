"""The Navigator's messages: announcements, the commands of a mission, landing targets and obstacles."""

from __future__ import annotations

from functools import partial
from typing import Any

from mavlink_sim.flight.precision_landing import LandingTarget
from mavlink_sim.missions import items as mission_items
from mavlink_sim.missions.items import MissionItem
from mavlink_sim.missions.navigator import Reached, goes_to_camera
from mavlink_sim.services import commands
from mavlink_sim.services.context import ServiceContext
from mavlink_sim.services.mission_messages import mission_current
from mavlink_sim.wire.announcements import CRITICAL, Text
from mavlink_sim.wire.links import AUTOPILOT_COMPONENT, Link
from mavlink_sim.wire.messages import Command, dialect

CAMERA_COMPONENT = 100  # MAV_COMP_ID_CAMERA
LOCAL_NED = 1  # MAV_FRAME_LOCAL_NED
HOLD_BEFORE_RETURN_S = 0.05
MAX_POSITION_M = 1e6
# a single shot goes to PX4's camera trigger as DO_DIGICAM_CONTROL, "shoot"
_SHOOT = (0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)


def update(vehicle: ServiceContext) -> None:
    """Send the announcements of this step, execute mission commands, update transfers."""
    navigator = vehicle.autopilot.navigator
    while navigator.announcements:
        announcement = navigator.announcements.popleft()
        for link in vehicle.links.values():
            if isinstance(announcement, Reached):
                link.send(dialect.MAVLink_mission_item_reached_message(announcement.sequence))
            elif navigator.mission.items:
                link.send(mission_current(vehicle))
    while navigator.commands:
        item = navigator.commands.popleft()
        if item.command == mission_items.RETURN_TO_LAUNCH and navigator.mission.finished:
            # measured: after its last item the mission is over, and HOLD is active before the return
            vehicle.after(HOLD_BEFORE_RETURN_S, partial(_carry_out, vehicle, item))
        else:
            _carry_out(vehicle, item)
    for session in navigator.sessions.values():
        session.update()


def _carry_out(vehicle: ServiceContext, item: MissionItem) -> None:
    """Send an item that is a command on every link, as PX4 does, and execute it if it is for the vehicle."""
    command, values = item.command, item.parameters
    if item.frame != mission_items.FRAME_MISSION:
        position = item.local_position(vehicle.autopilot.home.position, vehicle.local_frame)
        values = (*values[:6], vehicle.local_frame.geographic(position)[2])
    target = 0
    if goes_to_camera(command):
        target = CAMERA_COMPONENT
        if command not in (mission_items.START_VIDEO, mission_items.STOP_VIDEO) and 1.0 <= values[0] < 256.0:
            target = int(values[0])
        if command == mission_items.START_CAPTURE and values[2] == 1.0:
            command, values = mission_items.DIGICAM_CONTROL, _SHOOT
    for link in vehicle.links.values():
        link.send(dialect.MAVLink_command_long_message(vehicle.system_id, target, command, 0, *values))
    if target == 0 and vehicle.links:
        own = Command(command, values, AUTOPILOT_COMPONENT)
        commands.execute(vehicle, next(iter(vehicle.links.values())), own)


# ---- messages ---------------------------------------------------------------------------------------------


def landing_target(vehicle: ServiceContext, link: Link, message: Any) -> None:
    """LANDING_TARGET. PX4 uses a position in LOCAL_NED; angles are for an infrared beacon's estimator."""
    if not message.position_valid:
        return
    if message.frame != LOCAL_NED:
        text = Text(CRITICAL, f"Landing target: coordinate frame {message.frame} unsupported\t")
        vehicle.autopilot.texts.append(text)
        return
    point = (message.x, message.y, message.z)
    if all(abs(value) < MAX_POSITION_M for value in point):
        vehicle.autopilot.navigator.target = LandingTarget(point, vehicle.autopilot.now_s)


def obstacle_distance(vehicle: ServiceContext, link: Link, message: Any) -> None:
    """OBSTACLE_DISTANCE, for collision prevention."""
    increment = message.increment_f if message.increment_f > 0.0 else float(message.increment)
    try:
        vehicle.autopilot.navigator.obstacles.add(
            message.distances,
            increment,
            message.angle_offset,
            message.min_distance,
            message.max_distance,
            message.frame,
            vehicle.estimate.yaw_rad,
            vehicle.autopilot.now_s,
        )
    except ValueError as error:
        vehicle.autopilot.texts.append(Text(CRITICAL, f"{error}\t"))
