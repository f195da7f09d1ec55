"""Assembles guidance's input: vehicle state, perception results and other vehicles.

No asyncio and no clock: the service and flights in lockstep assemble their inputs here.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.select import FIRST_CAMERA, Select
from companion.guidance.command import BuildContext, Command, GrammarError
from companion.guidance.formation.neighbours import Neighbourhood, Neighbours
from companion.guidance.gimbal.controller import GimbalMounting
from companion.guidance.grammar import parse
from companion.guidance.interface import (
    Answer,
    ChangedLimits,
    CommandInput,
    CommandSource,
    GuidanceInput,
    StreamStatus,
)
from companion.guidance.objects.from_detections import StateHistory
from companion.guidance.objects.from_markers import NO_MARKERS, LocalizedMarkers
from companion.guidance.search_pattern import Footprint
from companion.host.clock import Standstill
from companion.perception.cameras import PerceptionCamera
from companion.perception.freeze_reports import FreezeReports
from companion.perception.marker_tracker import MarkerTracker
from companion.recording.guidance_record import StepContext
from companion.service.autopilot_reports import AutopilotReports
from companion.service.velocity_senders import VelocitySenders
from companion.settings import CameraSection, Settings
from companion.settings.plugins import load_plugins
from companion.vehicle.autopilot_parameters import NOTHING_READ
from companion.vehicle.state import VehicleState
from vision.pipeline import PerceptionResult
from vision.tracking import Selected

logger = logging.getLogger(__name__)

# Maximum length of a command line; a path of hundreds of points fits.
LONGEST_LINE = 8000


class InputAssembler:
    """Collects the input between two steps of guidance.

    Args:
        cameras: the cameras; `guidance.camera` names the steering one.
        on_event: called with (level, text) for the operator.

    Raises:
        PluginError: a module in `plugins.modules` cannot be loaded.

    Attributes:
        steering: the camera whose targets behaviours get.
        history: the vehicle's states of the last few seconds.
        poses: the other vehicles. velocities: the messages on the topic `velocity`.
        parameters, limits: as in `GuidanceInput`.
    """

    def __init__(
        self, settings: Settings, cameras: Sequence[PerceptionCamera], on_event: Callable[[str, str], None]
    ) -> None:
        load_plugins(settings.plugins.modules)
        self._settings = settings
        self._cameras = {camera.name: camera for camera in cameras}
        self.steering = next(camera for camera in cameras if camera.name == settings.guidance.camera)
        self.history = StateHistory()
        self.poses = Neighbours(settings.vehicle.name, on_event)
        self.velocities = VelocitySenders()
        self.parameters = NOTHING_READ
        self.limits: ChangedLimits | None = None
        self._alone = Neighbourhood(settings.vehicle.name)
        detecting = any(camera.settings.markers.dictionary is not None for camera in cameras)
        self._markers = MarkerTracker(cameras, on_event) if detecting else None
        self._state: VehicleState | None = None
        self._shown: tuple[int, bool] | None = None
        self._mode_changes = 0
        self._on_event = on_event
        self._reports = AutopilotReports(on_event)
        self._recorded_section: CameraSection | None = None
        self._section_json = ""
        self._freezes = FreezeReports(on_event)

    def on_state(self, state: VehicleState) -> None:
        """Process a new snapshot of the vehicle."""
        self._reports.update(state)
        # By its number: modes without a name here differ too, and a name of ours is not a change.
        if (state.custom_mode, state.armed) != self._shown:
            self._shown = (state.custom_mode, state.armed)
            self._mode_changes += 1
        self._state = state
        for camera in self._cameras.values():
            camera.in_flight = state.in_flight
        self.history.add(state)

    def on_result(self, camera: PerceptionCamera, result: PerceptionResult) -> LocalizedMarkers | None:
        """Process a camera's result, unless it repeats one; returns its markers if marker detection is on."""
        if camera.repeats or self._freezes.frozen:
            self._freezes.update(camera, result.captured_ns)
        if camera.repeats:
            return None
        if camera is self.steering:
            camera.localize(result, self.history)
        if result.markers is None or self._markers is None:
            return None
        return self._markers.localize(camera, result, self.history, self._state)

    def assemble(
        self,
        now_ns: int,
        state: VehicleState,
        stream: StreamStatus,
        *,
        answers: Sequence[Answer] = (),
        commands: Sequence[CommandInput] = (),
        ending: bool = False,
        standstill: Standstill | None = None,
    ) -> GuidanceInput:
        """Assemble the input of one step."""
        # What the vehicle does not have is not asked: markers, other vehicles, senders of velocities.
        steering, markers = self.steering, self._markers
        max_age_s = self._settings.guidance.perception_max_age_s
        return GuidanceInput(
            state,
            stream,
            steering.targets,
            steering.seen_ns,
            steering.obstacles,
            steering.planned,
            NO_MARKERS if markers is None else markers.sight(now_ns, max_age_s),
            self.poses.neighbourhood(state, now_ns) if self.poses.received else self._alone,
            steering.ranging(self.camera_pitch_rad(state)),
            steering.class_names,
            self._mode_changes,
            tuple(answers),
            tuple(commands),
            ending,
            NO_MARKERS if markers is None else markers.steering_sight(self.steering, now_ns, max_age_s),
            self.velocities.newest(now_ns) if self.velocities.received else (),
            self.parameters,
            standstill,
            steering.frozen(now_ns),
            steering.objects.objects,
            () if markers is None else markers.objects(steering),
            () if markers is None else markers.objects_below(),
            self.limits,
        )

    def discard_received(self, now_ns: int) -> None:
        """The computer stood still until now: images, poses and velocities from before are outdated."""
        self.history.discard()
        for camera in self._cameras.values():
            camera.discard_received(now_ns)
        if self._markers is not None:
            self._markers.discard_received()
        self.poses.discard_received(now_ns)
        self.velocities.discard_received(now_ns)

    def step_context(self, mounting: GimbalMounting) -> StepContext:
        """Return what is recorded of a step besides its input, for one caller.

        Args:
            mounting: of guidance's gimbal.
        """
        section = self.steering.settings.camera
        if section is not self._recorded_section:  # replaced by the camera's calibration
            self._recorded_section, self._section_json = section, section.model_dump_json()
        return StepContext(mounting, self._section_json, self.history.take_new())

    def camera_pitch_rad(self, state: VehicleState) -> float:
        """Pitch of the steering camera above the horizon, with the vehicle level."""
        camera, gimbal = self.steering.settings.camera, state.gimbal
        held_rad = gimbal.pitch_rad if camera.on_gimbal and gimbal is not None else None
        return math.radians(camera.mount_pitch_deg) + (held_rad or 0.0)

    def read_command(
        self,
        identifier: int,
        text: str,
        state: VehicleState,
        check_requirements: Callable[[Behaviour], str | None],
    ) -> CommandInput | Select:
        """Parse a command for guidance, or a selection for `select`.

        Args:
            text: one line; a mission's lines may follow, if its file is not on this computer.
            check_requirements: guidance's own, called by a mission at each of its steps.

        Raises:
            GrammarError: one line for each problem.
        """
        mode_changes = self._mode_changes  # before the rest, which takes time
        text, _, enclosed = text.strip().partition("\n")
        if len(text) > LONGEST_LINE:
            raise GrammarError(f"a command line has at most {LONGEST_LINE} characters, got {len(text)}")
        names = self.steering.class_names
        command = parse(text, names)
        if enclosed and not command.takes_attachment:
            raise GrammarError(f"{command}: expected one line; only a mission may have more lines")
        if isinstance(command, Select):
            return command
        if (aim := command.aim) is not None:
            return CommandInput(identifier, str(command), aim=aim, mode_changes=mode_changes)
        footprint = Footprint(self.steering.settings.camera.field_rad, -self.camera_pitch_rad(state))
        source = CommandSource(enclosed if enclosed.strip() else command.read_attachment(), footprint, names)
        rate_hz = self._settings.guidance.rate_hz
        context = BuildContext(footprint, names, source.attachment, check_requirements, rate_hz)
        return CommandInput(
            identifier,
            str(command),
            self._built(command, context),
            endless=command.endless,
            mode_changes=mode_changes,
            source=source,
        )

    async def select(self, command: Select) -> Selected:
        """Select an object in a camera's images, for commands with `track=`."""
        name, camera = command.camera, self.steering
        if name is not None:
            known = self._cameras.get(None if name == FIRST_CAMERA else name)
            if known is None:
                names = ", ".join(key or FIRST_CAMERA for key in self._cameras)
                return Selected(False, f"no camera {name!r}; there are: {names}")
            camera = known
        answer = await camera.select(command.request)
        if answer.track_id is None or camera is self.steering:
            return answer
        return replace(answer, reason=f"{answer.reason}; not of the steering camera, so no goal of a flight")

    @staticmethod
    def _built(command: Command, context: BuildContext) -> Behaviour:
        """Build the behaviour. Raises GrammarError, for an error of a plug-in too."""
        try:
            return command.build(context)
        except GrammarError:
            raise
        except Exception as error:
            # A plug-in's error must not end the service.
            logger.exception("%s cannot be built", command.word)
            raise GrammarError(f"{command.word}: {type(error).__name__}: {error}") from error
