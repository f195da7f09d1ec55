"""Builds the body of `status`: the state of every part of a service."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from companion.bus.bodies.service import (
    ChangedSettingBody,
    OtherCommanderBody,
    PartBody,
    StatusBody,
    StatusCameraBody,
    StatusCommandBody,
    StatusGimbalBody,
    StatusMissionBody,
)
from companion.bus.session import Bus
from companion.bus.topics import command_id
from companion.geometry.fence import Polygon
from companion.guidance.behaviour import Behaviour
from companion.guidance.core import Guidance
from companion.guidance.formation.neighbours import Neighbours
from companion.guidance.gimbal.controller import GimbalController
from companion.guidance.missions.sequence import SequenceBehaviour
from companion.host.clock import unix_offset_ns
from companion.perception.cameras import PerceptionCamera, WorkerCamera
from companion.perception.supervisor import PerceptionSupervisor
from companion.vehicle.autopilot_parameters import AutopilotParameters
from companion.vehicle.driver import Driver
from companion.vehicle.gimbal import address_text
from companion.vehicle.setpoint_loss import setpoint_loss_outcome, without_service_text
from companion.vehicle.state import VehicleState
from companion.vehicle.streamer import Streamer

RECENT_STEPS = 20


def status_message(
    now_ns: int,
    *,
    uptime_s: float,
    unhealthy: list[str],
    parts: list[PartBody],
    driver: Driver,
    guidance: Guidance,
    streamer: Streamer,
    cameras: Sequence[WorkerCamera],
    steering: PerceptionCamera,
    poses: Neighbours,
    parameters: AutopilotParameters,
    bus: Bus,
    others: list[OtherCommanderBody],
    dropped_lines: int,
    changed_settings: list[ChangedSettingBody],
) -> StatusBody:
    """Create the message published on `status` (`docs/messages.md`).

    Args:
        now_ns: CLOCK_MONOTONIC. steering: the camera that guidance uses. others: services that command the
            same vehicle. parameters: read from the autopilot. dropped_lines: of the log.
    """
    state, limits, received = driver.state, guidance.setpoints.limits, driver.reception
    seeing = not steering.overdue(now_ns)
    has_vehicle = any(part["name"] == "autopilot" for part in parts)
    silence = setpoint_loss_outcome(parameters, sticks_present=state.sticks_present)
    return {
        "stamp_ns": now_ns,
        "unix_offset_ns": unix_offset_ns(),
        "service": poses.source,
        "uptime_s": round(uptime_s, 1),
        "healthy": not unhealthy,
        "unhealthy": unhealthy,
        "parts": parts,
        "vehicle": {
            "name": poses.vehicle,
            "connected": state.connected(now_ns),
            "autopilot": state.autopilot,
            "firmware": None if parameters.version is None else str(parameters.version),
            "driver": driver.library,
            "mode": state.mode.value,
            "armed": state.armed,
            "failsafe": state.failsafe,
            "not_flown": state.not_flown,
            "sticks": parameters.sticks_text,
            "silence": {
                "effect": silence.effect.value,
                "mode": silence.mode.value,
                "after_s": None if silence.after_s is None else round(silence.after_s, 2),
                "warning": silence.warning,
                "text": silence.text,
            },
            "without_service": without_service_text(state, parameters, has_vehicle=has_vehicle),
            "missing_streams": list(state.missing_streams),
            "reception": {
                "frames": received.frames,
                "split": received.split,
                "lost": received.lost,
                "skipped_bytes": received.skipped_bytes,
            },
            "status_texts": [report.text for report in state.reports],
            "other_commanders": others,
        },
        "pilot": {
            "in_command": guidance.in_command,
            "behaviour": guidance.status,
            "stream": streamer.state.value,
            "setpoints_sent": streamer.sent_count,
            "mission": _mission(guidance.behaviour),
            "command": _command(guidance, poses.source),
        },
        "limits": {
            "max_distance_m": limits.max_distance_m,
            "max_altitude_m": limits.max_altitude_m,
            "max_horizontal_speed_mps": limits.max_horizontal_speed_mps,
            "max_climb_mps": limits.max_climb_mps,
            "max_descend_mps": limits.max_descend_mps,
            "fence_include": _corners(limits.fence.include),
            "fence_exclude": [_corners(polygon) for polygon in limits.fence.exclude],
        },
        "changed_settings": changed_settings,
        "perception": _camera(cameras[0].supervisor),
        "cameras": {camera.name: _camera(camera.supervisor) for camera in cameras if camera.name},
        "targets": {
            "camera": steering.name,
            "count": len(steering.targets) if seeing else 0,
            "localization_error": steering.localization_error if seeing else "",
        },
        "gimbal": _gimbal(guidance.gimbal, now_ns, state),
        "neighbours": {
            "ages_s": poses.ages_s(now_ns),
            "out_of_order": poses.refused,
        },
        "bus": {
            "connected": bus.connected,
            "published": dict(bus.published),
            "publish_failed": bus.publish_failed,
            "refused_commands": bus.intake.refused,
            "ignored": bus.ignored,
        },
        "log": {"dropped_lines": dropped_lines},
    }


def _command(guidance: Guidance, service: str) -> StatusCommandBody | None:
    command = guidance.runner.command
    if command is None:
        return None
    return {"id": command_id(service, command.identifier), "command": command.text}


def _mission(behaviour: Behaviour | None) -> StatusMissionBody | None:
    if not isinstance(behaviour, SequenceBehaviour):
        return None
    return {
        "name": behaviour.plan.name,
        "steps": [step.title for step in behaviour.plan.steps],
        "current": behaviour.current,
        "failure": behaviour.failure,
        "ended": [
            {
                "title": record.title,
                "command": record.command,
                "success": record.success,
                "reason": record.reason,
                "started_ns": record.started_ns,
                "ended_ns": record.ended_ns,
            }
            for record in behaviour.records[-RECENT_STEPS:]
        ],
    }


def _corners(polygon: Polygon) -> list[list[float]]:
    return [list(corner) for corner in polygon]


def _camera(supervisor: PerceptionSupervisor) -> StatusCameraBody:
    status, ready = supervisor.status, supervisor.ready
    return {
        "state": status.state.value,
        "pid": status.pid,
        "restarts": status.restarts,
        "frames": status.frames,
        "results": status.results,
        "rate_hz": round(status.rate_hz, 2),
        "sequence": None if status.newest is None else status.newest.sequence,
        "age_s": None if status.age_s is None else round(status.age_s, 3),
        "timing_ms": _rounded(status.timing_ms),
        "timing_p50_ms": _rounded(status.timing_p50_ms),
        "timing_p99_ms": _rounded(status.timing_p99_ms),
        "dropped": status.dropped,
        "frames_skipped": dict(status.frames_skipped),
        "frames_repeated": dict(status.frames_repeated),
        "stuck_after_s": status.stuck_after_s,
        "class_names": list(status.class_names),
        "tracks": status.tracks,
        "model": None if ready is None else ready.model,
        "model_sha256": None if ready is None else ready.model_sha256,
        "runtime": status.runtime,
        "precision": None if ready is None else ready.precision,
        "runtime_reason": status.runtime_reason,
        "problem": status.problem,
    }


def _gimbal(controller: GimbalController, now_ns: int, state: VehicleState) -> StatusGimbalBody | None:
    """Return the gimbal's fields; None where there is no gimbal and none is expected."""
    gimbal = state.gimbal
    if gimbal is None and not controller.mounting.carries_camera:
        return None
    pitch_rad = gimbal.pitch_rad if gimbal is not None and gimbal.attitude_fresh(now_ns) else None
    primary = None if gimbal is None else gimbal.primary_control
    return {
        "answers": gimbal is not None,
        "pitch_deg": None if pitch_rad is None else round(math.degrees(pitch_rad), 1),
        "primary_control": None if primary is None else address_text(primary),
        "ours": controller.in_control(now_ns, state),
        "problem": controller.problem(now_ns, state),
    }


def _rounded(timing_ms: Mapping[str, float]) -> dict[str, float]:
    return {stage: round(value, 3) for stage, value in timing_ms.items()}
