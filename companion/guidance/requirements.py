"""Check of a behaviour's requirements before it begins; the reply names what is missing.

A mission, and whatever else begins others (`Behaviour.later`), begins only if nothing is missing for any of
them, as far as that is known now: nothing is armed for a step that cannot be flown.
"""

from __future__ import annotations

from collections.abc import Sequence

from companion.guidance.behaviour import OF_THE_MOMENT, Behaviour, BehaviourContext, Requirement
from companion.guidance.formation.neighbours import missing_neighbours
from companion.guidance.gimbal.controller import missing_gimbal
from companion.guidance.limits.battery import NO_MINIMUM, BatteryMinimum
from companion.guidance.limits.obstacles import NO_RULES, ObstacleRules
from companion.vehicle.state import LandedState

PERCEPTION_GAP_S = 1.5
"""A detector whose newest frame is at most this old is running.

It may be late for a moment, for example while a small computer starts the program that sends the command.
Steering requires `perception_fresh`; until then behaviours brake.
"""

AIRBORNE = (LandedState.IN_AIR, LandedState.TAKING_OFF, LandedState.LANDING)


def check_requirements(
    behaviour: Behaviour,
    context: BehaviourContext | None,
    class_names: Sequence[str] | None,
    battery: BatteryMinimum = NO_MINIMUM,
    obstacles: ObstacleRules = NO_RULES,
) -> str | None:
    """Why this behaviour cannot begin now, in one line; None: it can.

    Args:
        context: the newest; None before the first.
        class_names: the detector's classes; None: not known, not checked.
        battery: minimum charge. obstacles: whether depth is needed.
    """
    if context is None:
        return "vehicle state not received yet"
    if not context.state.connected(context.now_ns):
        return "no link to the autopilot"
    if (why := context.state.not_flown) is not None:
        return why
    rules = (class_names, battery, obstacles)
    if missing := _missing(behaviour, behaviour.needs, context, *rules):
        return f"{behaviour.name} needs {' and '.join(missing)}"
    for later in behaviour.later:
        if missing := _missing(later, later.needs - OF_THE_MOMENT, context, *rules):
            return f"{behaviour.name}: {later.name} needs {' and '.join(missing)}"
    if behaviour.subject is not None and behaviour.subject.track_id is not None:
        why = context.objects.missing(behaviour.subject)
        return None if why is None else f"{behaviour.name}: {why}"
    return None


def _missing(
    behaviour: Behaviour,
    requirements: frozenset[Requirement],
    context: BehaviourContext,
    class_names: Sequence[str] | None,
    battery: BatteryMinimum,
    obstacles: ObstacleRules,
) -> list[str]:
    """What is missing for a behaviour, in words."""
    state, now_ns = context.state, context.now_ns
    missing = []
    for requirement in sorted(requirements):
        match requirement:
            case Requirement.POSITION if (fault := state.position_fault(now_ns)) is not None:
                missing.append(f"position ({fault})")
            case Requirement.IN_AIR if not (state.armed and state.landed in AIRBORNE):
                missing.append(f"to be in the air ({_where(context)})")
            case Requirement.ON_GROUND if state.landed is not LandedState.ON_GROUND:
                missing.append(f"to be on the ground ({_where(context)})")
            case Requirement.HOME if (fault := state.home_fault()) is not None:
                missing.append(f"home ({fault})")
            case Requirement.PERCEPTION if not _perceiving(context):
                missing.append(f"perception ({_perception_age(context)})")
            case Requirement.GIMBAL:
                missing += missing_gimbal(state, now_ns, context.gimbal, behaviour.gimbal_pitches_rad)
                seeing = {Requirement.PERCEPTION, Requirement.STEERING_MARKER} & requirements
                if seeing and not context.gimbal.carries_camera:
                    missing.append("the camera on the gimbal (camera.on_gimbal is not set)")
            case Requirement.DEPTH_OR_SIZE:
                if (why := context.ranging.missing(_class_names(behaviour, context))) is not None:
                    missing.append(why)
            case Requirement.NEIGHBOURS:
                missing += missing_neighbours(context.neighbourhood, behaviour.neighbour_names, state, now_ns)
            case Requirement.STEERING_MARKER if (
                what := context.steering_markers.unavailable(PERCEPTION_GAP_S)
            ) is not None:
                missing.append(what)
            case Requirement.PERCEPTION | Requirement.STEERING_MARKER if context.gimbal.direction_fault:
                missing.append(f"the camera's direction ({context.gimbal.direction_fault})")
            case Requirement.MARKER if (what := context.markers.unavailable(PERCEPTION_GAP_S)) is not None:
                missing.append(what)
    if (charge := battery.missing(behaviour, state, now_ns)) is not None:
        missing.append(charge)
    if (depth := obstacles.missing(behaviour, context)) is not None:
        missing.append(depth)
    if class_names is not None:
        known = () if behaviour.subject is None else behaviour.subject.class_names
        unknown = [name for name in (*behaviour.class_names, *known) if name not in class_names]
        if unknown:
            missing.append(f"a detector that knows {', '.join(unknown)}")
    return missing


def _class_names(behaviour: Behaviour, context: BehaviourContext) -> tuple[str, ...]:
    """The classes that it flies to, its track's included."""
    subject = behaviour.subject
    if subject is None or subject.track_id is None:
        return (*behaviour.class_names, *(() if subject is None else subject.class_names))
    return tuple({each.class_name for each in context.objects.objects if subject.means(each)})


def _where(context: BehaviourContext) -> str:
    armed = "armed" if context.state.armed else "disarmed"
    landed = context.state.landed.value.replace("_", " ")
    return f"{armed}, {'landed state unknown' if landed == 'unknown' else landed}"


def _perceiving(context: BehaviourContext) -> bool:
    age_s = context.perception_age_s
    return context.perception_fresh or (age_s is not None and age_s <= PERCEPTION_GAP_S)


def _perception_age(context: BehaviourContext) -> str:
    if context.perception_age_s is None:
        return "no detections received yet"
    return context.camera_fault or f"newest frame {context.perception_age_s:.1f} s old"
