"""The options of a simulation in real time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mavlink_sim.vehicles.firmware import PX4


@dataclass(frozen=True)
class SimulationOptions:
    """The options of a simulation, with the names and defaults of the command line, whose help explains them.

    Attributes:
        onboard_bind, gcs_bind: UDP ports it binds; 0 selects free ones.
        wind_mps: steady wind; `seed` sets its direction, the gusts and the world.
        gusts_mps: standard deviation of the gusts per axis; None for the default, 0 for none.
        world_seed: sets them instead, the same for all vehicles of a fleet; None: `seed`.
        camera: name of the shared-memory segment the camera's frames go to; None for no shared memory.
        camera_outputs: further addresses the frames go to (`video_outputs`).
        scene: a scene file, or the name of an example (`scene_file.load_scene`), whose objects are obstacles;
            None for the demo world, which is only visible.
        start_ned_m: north and east of SIH's home, the start and origin of its local frame.
        signing_key: 32 bytes for MAVLink 2 signing on every link; MAV_SIGN_CFG sets what is refused.
        console: read faults from standard input; None: if that is a terminal.
    """

    host: str = "127.0.0.1"
    onboard_port: int = 14540
    onboard_bind: int = 14580
    gcs_port: int = 14550
    gcs_bind: int = 18570
    system_id: int = 1
    seed: int = 0
    world_seed: int | None = None
    wind_mps: float = 0.0
    gusts_mps: float | None = None
    camera: str | None = None
    camera_rate_hz: float | None = None
    camera_outputs: tuple[str, ...] = ()
    camera_truth: Path | None = None
    scene: str | None = None
    obstacle_sensor: bool = False
    truth: Path | None = None
    record: Path | None = None
    ready_after_s: float = 3.0
    autopilot: str = PX4
    px4: str | None = None
    speed: float = 1.0
    noise: float = 1.0
    start_ned_m: tuple[float, float] = (0.0, 0.0)
    parameters: dict[str, float] = field(default_factory=dict)
    gimbal: bool = False
    signing_key: bytes | None = field(default=None, repr=False)
    faults: tuple[str, ...] = ()
    console: bool | None = None
    control: str | None = None

    @property
    def shows_world(self) -> bool:
        """Whether there is a camera."""
        return self.camera is not None or bool(self.camera_outputs) or self.camera_truth is not None
