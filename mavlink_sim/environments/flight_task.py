"""What the tasks in flight share: the model, random conditions, and a camera that sees one object.

The object's position is measured at 20 Hz with the errors of a detector, arrives late, and is missing in some
frames and outside the image. Between measurements the last known position is kept and its age grows.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments import drawing
from mavlink_sim.environments.autopilot_model import AutopilotModel
from mavlink_sim.environments.fast_model import FastModel
from mavlink_sim.environments.spaces import MAX_AGE_S, VELOCITY_ACTION, Array, high
from mavlink_sim.environments.task import STEP_S, Task
from mavlink_sim.vehicles.vehicle import BACKGROUND_GUSTS_MPS, GUST_SHARE_OF_WIND

MODELS: dict[str, type[FastModel | AutopilotModel]] = {"fast": FastModel, "autopilot": AutopilotModel}
# The companion limits changes of a demanded velocity to this (its default).
MAX_ACCELERATION_M_S2 = 3.0
# The companion's default camera.
TAN_ACROSS = math.tan(math.radians(80.0) / 2.0)
TAN_ALONG = 0.75 * TAN_ACROSS
BEARING_NOISE_RAD = 0.01
_DELAYS = 16

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class Conditions:
    """The ranges from which each episode draws its conditions, uniformly; equal ends fix one.

    Attributes:
        wind_m_s: steady horizontal wind from any direction; gusts grow with it, as in the simulator.
        latency_s: from a frame to its detection, in steps of 0.05 s.
        noise: standard deviation of a measured position along the line of sight, as a fraction of the range.
        mass: relative to the airframe's 1 kg.
        misses: the fraction of frames without a detection.
    """

    wind_m_s: Range = (0.0, 3.0)
    latency_s: Range = (0.05, 0.2)
    noise: Range = (0.0, 0.05)
    mass: Range = (0.9, 1.2)
    misses: Range = (0.0, 0.3)

    def __post_init__(self) -> None:
        limits = {
            "wind_m_s": (0.0, 15.0),
            "latency_s": (0.0, (_DELAYS - 1) * STEP_S),
            "noise": (0.0, 1.0),
            "mass": (0.5, 1.5),
            "misses": (0.0, 1.0),
        }
        for field in fields(self):
            least, most = limits[field.name]
            value = getattr(self, field.name)
            try:
                first, last = (float(number) for number in value)
            except (TypeError, ValueError):
                first, last = math.nan, math.nan
            if not least <= first <= last <= most:
                raise ValueError(
                    f"{field.name}: expected (low, high) within {least:g} to {most:g}, got {value!r}"
                )


class FlightTask(Task):
    """A vehicle that flies velocities and sees one object.

    Args:
        count: episodes side by side.
        model: "fast", the arrays of `FastModel`, or "autopilot", a whole simulated vehicle for each.
        conditions: ranges of `Conditions`, by keyword.
    """

    action = VELOCITY_ACTION
    max_steps = 600
    height_m: Range = (1.5, 3.5)
    camera_pitch_rad = math.radians(-10.0)

    def __init__(self, count: int, model: str = "fast", **conditions: Any) -> None:
        super().__init__(count)
        if model not in MODELS:
            raise ValueError(f"model {model!r}: expected one of {', '.join(MODELS)}")
        self.conditions = Conditions(**conditions)
        self.model = MODELS[model](count)
        self.target, self.seen, self._setpoint = (np.zeros((3, count)) for _ in range(3))
        self.age_s, self._noise, self._misses = (np.zeros(count) for _ in range(3))
        self._delay = np.zeros(count, np.intp)
        self._index = 0
        self._measured = np.zeros((_DELAYS, 3, count))
        self._valid = np.zeros((_DELAYS, count), bool)
        self._columns = np.arange(count)
        self._full = high(self.action)[:, None]
        self._last_action = np.zeros((len(self.action), count))
        self.change = np.zeros(count)

    @abstractmethod
    def place(self, which: NDArray[np.intp], yaw_rad: Array, rng: np.random.Generator) -> None:
        """Set `target` for new episodes whose vehicles are in position."""

    @abstractmethod
    def judge(self) -> tuple[Array, NDArray[np.bool_]]:
        """(count,) rewards of the last step, and whether each episode has ended."""

    def begin(self, which: NDArray[np.intp], rng: np.random.Generator) -> None:
        size = len(which)
        drawn: dict[str, Array] = {}
        for field in fields(self.conditions):
            least, most = getattr(self.conditions, field.name)
            drawn[field.name] = rng.uniform(least, most, size)
        model = self.model
        wind, direction = drawn["wind_m_s"], rng.uniform(0.0, math.tau, size)
        model.wind[:, which] = np.stack([wind * np.cos(direction), wind * np.sin(direction), np.zeros(size)])
        model.gusts_m_s[which] = BACKGROUND_GUSTS_MPS + GUST_SHARE_OF_WIND * wind
        model.mass[which] = drawn["mass"]
        self._noise[which], self._misses[which] = drawn["noise"], drawn["misses"]
        self._delay[which] = np.rint(drawn["latency_s"] / STEP_S)
        yaw_rad = rng.uniform(-math.pi, math.pi, size)
        position = np.zeros((3, size))
        position[2] = -rng.uniform(*self.height_m, size)
        model.begin(which, position, yaw_rad, rng)
        self.place(which, yaw_rad, rng)
        self._setpoint[:, which] = 0.0
        self._last_action[:, which] = 0.0
        self._valid[:, which] = False
        self.age_s[which] = self._delay[which] * STEP_S
        self.seen[:, which] = self._measure(rng)[:, which]

    def step(self, action: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
        model = self.model
        forward, right, up, turn = action
        cosine, sine = np.cos(model.yaw_rad), np.sin(model.yaw_rad)
        wanted = np.stack([forward * cosine - right * sine, forward * sine + right * cosine, -up])
        change = wanted - self._setpoint
        length = np.sqrt((change * change).sum(0))
        self._setpoint += change * np.minimum(1.0, MAX_ACCELERATION_M_S2 * STEP_S / np.maximum(length, 1e-9))
        model.fly(self._setpoint, turn, rng)
        self._see(rng)
        self.change = (((action - self._last_action) / self._full) ** 2).sum(0)
        self._last_action = action.copy()
        reward, ended = self.judge()
        return reward, ended | model.failed

    def _see(self, rng: np.random.Generator) -> None:
        """Take a frame, and receive the detection of an earlier one."""
        self._index = (self._index + 1) % _DELAYS
        self._measured[self._index] = self._measure(rng)
        self._valid[self._index] = self.in_image() & (rng.random(self.count) >= self._misses)
        slot = (self._index - self._delay) % _DELAYS
        arrived = self._valid[slot, self._columns]
        newest = self._measured[slot, :, self._columns].T
        self.seen = np.where(arrived, newest, self.seen)
        self.age_s = np.where(arrived, self._delay * STEP_S, self.age_s + STEP_S)

    def _measure(self, rng: np.random.Generator) -> Array:
        """(3, count) NED, the object's position as measured now."""
        line = self.target - self.model.position
        distance = np.sqrt((line * line).sum(0))
        along, *across = rng.standard_normal((4, self.count))
        error = line * (self._noise * along) + np.stack(across) * (distance * BEARING_NOISE_RAD)
        measured: Array = self.model.estimated_position + line + error
        return measured

    def in_image(self) -> NDArray[np.bool_]:
        """(count,) whether the object is in the image of the camera, which tilts with the vehicle."""
        x, y, z = (self.model.rotation * (self.target - self.model.position)[:, None]).sum(0)
        cosine, sine = math.cos(self.camera_pitch_rad), math.sin(self.camera_pitch_rad)
        depth, down = x * cosine - z * sine, x * sine + z * cosine
        inside = (np.abs(y) < depth * TAN_ACROSS) & (np.abs(down) < depth * TAN_ALONG) & (depth > 0.1)
        return np.asarray(inside, np.bool_)

    def level(self, ned: Array) -> Array:
        """(3, count) a NED vector in the BODY LEVEL frame by the vehicle's own heading."""
        cosine, sine = np.cos(self.model.yaw_rad), np.sin(self.model.yaw_rad)
        return np.stack([cosine * ned[0] + sine * ned[1], cosine * ned[1] - sine * ned[0], -ned[2]])

    def sight(self) -> list[Array]:
        """The rows of what is seen: the object's position, the velocity, the age."""
        return [
            *self.level(self.seen - self.model.estimated_position),
            *self.level(self.model.estimated_velocity),
            self.age_s,
        ]

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(count,) the last known position is too old, or the vehicle too low."""
        return np.asarray((self.age_s > MAX_AGE_S) | (self.model.position[2] > -0.5), np.bool_)

    def draw(self) -> NDArray[np.uint8]:
        north, east, down = (float(value) for value in self.model.position[:, 0])
        target, seen, yaw = self.target[:, 0], self.seen[:, 0], float(self.model.yaw_rad[0])
        width_m = 2.4 * max(8.0, abs(target[0] - north), abs(target[1] - east))
        above = drawing.View(width_m, (east, north))
        side = drawing.View(width_m, (east, -down))
        nose = (east + 1.5 * math.sin(yaw), north + 1.5 * math.cos(yaw))
        side.line((east - width_m, 0.0), (east + width_m, 0.0), drawing.GREY)
        above.line((east, north), nose, drawing.VEHICLE)
        for view, vehicle, goal, found in (
            (above, (east, north), (target[1], target[0]), (seen[1], seen[0])),
            (side, (east, -down), (target[1], -target[2]), (seen[1], -seen[2])),
        ):
            view.circle(goal, 0.4, drawing.TARGET, -1)
            view.circle(found, 0.4, drawing.SEEN)
            view.circle(vehicle, 0.3, drawing.VEHICLE, -1)
        return np.concatenate([above.image, side.image], axis=1)
