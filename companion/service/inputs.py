"""What guidance is told: the vehicle's states, what the cameras saw and the other vehicles, as one input.

No asyncio and no clock: the service and a flight in lockstep assemble their inputs here.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from typing import Any

from companion.guidance.arguments import GrammarError
from companion.guidance.behaviour import Behaviour
from companion.guidance.command import BuildContext, Command
from companion.guidance.grammar import parse
from companion.guidance.interface import Answer, CommandInput, GuidanceInput, StreamStatus
from companion.guidance.pose_sharing import PoseSharing
from companion.guidance.search_pattern import Footprint
from companion.guidance.targets.from_detections import StateHistory
from companion.perception.views import View
from companion.perception.views_markers import MarkerTracker
from companion.plugins import load_plugins
from companion.settings import Settings
from companion.vehicle.px4_modes import among_modes
from companion.vehicle.report import Report
from companion.vehicle.state import FlightMode, VehicleState
from vision.obstacle_sectors import ObstacleSectors
from vision.pipeline import PerceptionResult

logger = logging.getLogger(__name__)

# Of the line of a command; the longest that is of use is a path of hundreds of points.
LONGEST_LINE = 8000
# A text of the autopilot's that comes again and again is told so often, and so many texts are remembered.
TELL_AGAIN_S, MOST_TOLD = 10.0, 100


class InputAssembler:
    """Gathers what comes in between two steps of guidance.

    Args:
        views: the cameras; the one that `guidance.camera` names steers.
        on_event: called with (level, text) for what a person should know.

    Raises:
        PluginError: a module that `plugins.modules` names cannot be loaded.

    Attributes:
        steering: the view whose targets behaviours see.
        history: where the vehicle was in the last few seconds.
        poses: the other vehicles.
    """

    def __init__(
        self, settings: Settings, views: Sequence[View], on_event: Callable[[str, str], None]
    ) -> None:
        load_plugins(settings.plugins.modules)
        self._settings = settings
        self.steering = next(view for view in views if view.name == settings.guidance.camera)
        self.history = StateHistory()
        self.poses = PoseSharing(settings.vehicle.name, on_event)
        self._markers = MarkerTracker(views)
        self._obstacles: ObstacleSectors | None = None
        self._shown: tuple[FlightMode, bool] | None = None
        self._mode_changes = 0
        self._on_event = on_event
        self._reported: tuple[Report, ...] = ()
        self._told_ns: dict[str, int] = {}

    def on_state(self, state: VehicleState) -> None:
        """A new snapshot of the vehicle."""
        if state.reports is not self._reported:
            self._log_reports(state)
        if (state.mode, state.armed) != self._shown:
            self._shown = (state.mode, state.armed)
            self._mode_changes += 1
        self.history.add(state)

    def _log_reports(self, state: VehicleState) -> None:
        """What the autopilot warns of, if it is about the mode that is flown."""
        last_ns = self._reported[-1].stamp_ns if self._reported else 0
        self._reported = state.reports
        for one in state.warnings_since(last_ns + 1):
            told_ns = self._told_ns.get(one.text)
            again = told_ns is None or one.stamp_ns - told_ns >= TELL_AGAIN_S * 1e9
            if again and among_modes(state.mode, one.modes):
                self._told_ns[one.text] = one.stamp_ns
                self._on_event("warning", f"autopilot: {one.text}")
        if len(self._told_ns) > MOST_TOLD:
            self._told_ns.clear()

    def on_result(self, view: View, result: PerceptionResult, now_ns: int) -> dict[str, Any] | None:
        """What a view saw in one frame. Returns the message about its markers, where some are looked for."""
        markers = None
        if result.markers is not None:
            name = self._settings.vehicle.name
            markers = self._markers.take(view, result, self.history, name, now_ns)
        if view is self.steering:
            view.place(result, self.history)
            if result.obstacles is not None:
                self._obstacles = result.obstacles
        return markers

    def assemble(
        self,
        now_ns: int,
        state: VehicleState,
        stream: StreamStatus,
        *,
        answers: Sequence[Answer] = (),
        commands: Sequence[CommandInput] = (),
        ending: bool = False,
    ) -> GuidanceInput:
        """Everything that is known now."""
        steering, newest = self.steering, self.steering.newest
        return GuidanceInput(
            state,
            stream,
            steering.targets,
            None if newest is None else newest.captured_ns,
            self._obstacles,
            self._markers.sight(now_ns, self._settings.guidance.perception_max_age_s),
            self.poses.neighbourhood(state, now_ns),
            steering.ranging(self.camera_pitch_rad(state)),
            steering.class_names,
            self._mode_changes,
            tuple(answers),
            tuple(commands),
            ending,
        )

    def camera_pitch_rad(self, state: VehicleState) -> float:
        """Of the steering camera above the horizon, with the vehicle level."""
        camera, gimbal = self.steering.settings.camera, state.gimbal
        held_rad = gimbal.pitch_rad if camera.on_gimbal and gimbal is not None else None
        return math.radians(camera.mount_pitch_deg) + (held_rad or 0.0)

    def read_command(
        self,
        identifier: int,
        text: str,
        state: VehicleState,
        check_requirements: Callable[[Behaviour], str | None],
    ) -> CommandInput:
        """A command as guidance takes it.

        Args:
            text: one line; of a mission that is not on this computer its own lines may follow.
            check_requirements: guidance's own, asked by a mission at each of its steps.

        Raises:
            GrammarError: with what is wrong, a line for each problem.
        """
        text, _, enclosed = text.strip().partition("\n")
        if len(text) > LONGEST_LINE:
            raise GrammarError(
                f"a command has at most {LONGEST_LINE} characters in its line, got {len(text)}"
            )
        names = self.steering.class_names
        command = parse(text, names)
        if enclosed and not command.takes_attachment:
            raise GrammarError(f"{command}: one command at a time; only a mission may have more lines")
        if (aim := command.aim) is not None:
            return CommandInput(identifier, str(command), aim=aim, mode_changes=self._mode_changes)
        footprint = Footprint(self.steering.settings.camera.field_rad, -self.camera_pitch_rad(state))
        context = BuildContext(footprint, names, enclosed, check_requirements)
        return CommandInput(
            identifier,
            str(command),
            self._built(command, context),
            endless=command.endless,
            mode_changes=self._mode_changes,
        )

    @staticmethod
    def _built(command: Command, context: BuildContext) -> Behaviour:
        try:
            return command.build(context)
        except GrammarError:
            raise
        except Exception as error:
            # A plug-in must not be able to end the service.
            logger.exception("%s cannot be built", command.word)
            raise GrammarError(f"{command.word}: {type(error).__name__}: {error}") from error
