"""The rate of each message on each kind of link.

`ONBOARD_RATES_HZ` were measured on a PX4's onboard link, `GCS_RATES_HZ` on its ground station's. By that
PX4's own stamps they are the rates that it is configured for (100, 50, 30, 10, 8, 5 Hz): its clock ran 1.5 to
1.8 % slower than the receiver's. A requested interval is measured by the same clock.
"""

from __future__ import annotations

import heapq

NEVER_US = 2**63
# PX4's clock by the receiver's: 98.5 Hz for 100 Hz, 9.8 Hz for an interval of 100 ms.
PX4_CLOCK_RATE = 0.985
# By the measured rate the interval that PX4 is configured for, where the two differ.
_CONFIGURED_US = {98.5: 10_000, 49.0: 20_000, 29.5: 33_333, 9.85: 100_000, 7.9: 125_000, 4.95: 200_000}

ONBOARD_RATES_HZ: dict[str, float] = {
    "HEARTBEAT": 1.0,
    "ATTITUDE": 98.5,
    "ATTITUDE_QUATERNION": 49.0,
    "GLOBAL_POSITION_INT": 49.0,
    "HIGHRES_IMU": 49.0,
    "LOCAL_POSITION_NED": 29.5,
    "ODOMETRY": 29.5,
    "TIMESYNC": 9.85,
    "ALTITUDE": 9.85,
    "DISTANCE_SENSOR": 9.85,
    "ATTITUDE_TARGET": 9.85,
    "POSITION_TARGET_LOCAL_NED": 9.85,
    "POSITION_TARGET_GLOBAL_INT": 9.85,
    "ORBIT_EXECUTION_STATUS": 4.95,  # as configured in PX4; sent while orbiting
    "SERVO_OUTPUT_RAW": 9.85,
    "VFR_HUD": 9.85,
    "GPS_RAW_INT": 7.9,
    "EXTENDED_SYS_STATE": 4.95,
    "SYS_STATUS": 4.95,
    "ESTIMATOR_STATUS": 1.0,
    "OPEN_DRONE_ID_LOCATION": 1.0,
    "OPEN_DRONE_ID_SYSTEM": 1.0,
    "PING": 1.0,
    "SCALED_PRESSURE": 1.0,
    "SYSTEM_TIME": 1.0,
    "LINK_NODE_STATUS": 1.0,
    "MISSION_CURRENT": 1.0,
    "BATTERY_STATUS": 0.5,
    "CURRENT_MODE": 0.5,
    "HOME_POSITION": 0.5,
    "VIBRATION": 0.5,
    "TIME_ESTIMATE_TO_TARGET": 0.5,
    "CURRENT_EVENT_SEQUENCE": 0.3,
    "GPS_GLOBAL_ORIGIN": 0.0,  # on change only
    "OBSTACLE_DISTANCE": 0.0,  # to a ground station only, unless requested
}
GCS_RATES_HZ: dict[str, float] = dict.fromkeys(ONBOARD_RATES_HZ, 0.0) | {
    "HEARTBEAT": 1.0,
    "ATTITUDE": 49.0,
    "ATTITUDE_QUATERNION": 49.0,
    "ATTITUDE_TARGET": 49.0,
    "GLOBAL_POSITION_INT": 49.0,
    "LOCAL_POSITION_NED": 49.0,
    "POSITION_TARGET_LOCAL_NED": 49.0,
    "SERVO_OUTPUT_RAW": 49.0,
    "GPS_RAW_INT": 5.0,
    "ALTITUDE": 1.0,
    "EXTENDED_SYS_STATE": 1.0,
    "ESTIMATOR_STATUS": 0.5,
    "POSITION_TARGET_GLOBAL_INT": 1.0,
    "ORBIT_EXECUTION_STATUS": 2.0,
    "SCALED_PRESSURE": 1.0,
    "SYSTEM_TIME": 1.0,
    "SYS_STATUS": 1.0,
    "VFR_HUD": 1.0,
    "MISSION_CURRENT": 1.0,
    "OPEN_DRONE_ID_LOCATION": 1.0,
    "OPEN_DRONE_ID_SYSTEM": 1.0,
    "LINK_NODE_STATUS": 1.0,
    "BATTERY_STATUS": 0.5,
    "CURRENT_MODE": 0.5,
    "HOME_POSITION": 0.5,
    "TIME_ESTIMATE_TO_TARGET": 0.5,
    "DISTANCE_SENSOR": 0.5,
    "CURRENT_EVENT_SEQUENCE": 0.3,
    "PING": 0.1,
    "VIBRATION": 0.1,
    "OBSTACLE_DISTANCE": 1.0,  # as configured in PX4; sent while collision prevention works
}

# Additional streams with a remote control or a gimbal, from PX4's source: (onboard link, any other link).
EQUIPMENT_RATES_HZ: dict[str, tuple[float, float]] = {
    "RC_CHANNELS": (20.0, 5.0),
    "GIMBAL_DEVICE_ATTITUDE_STATUS": (5.0, 5.0),
    "GIMBAL_MANAGER_STATUS": (0.5, 0.5),
    "MOUNT_ORIENTATION": (10.0, 10.0),
}


class Streams:
    """The schedule of one link. Intervals are microseconds; a stream that is off has interval -1.

    `next_us` is when a message is due again: before that, `due` need not be called.

    Args:
        rates_hz: of each stream, as received. phase_s: when the schedule begins.
        clock_rate: of the clock by which a requested interval is measured.
    """

    def __init__(self, rates_hz: dict[str, float], phase_s: float = 0.0, clock_rate: float = 1.0) -> None:
        self._clock_rate = clock_rate
        self._rates_hz = rates_hz
        self._asked_us: dict[str, int] = {}
        self._default_us = {name: _interval_us(rate) for name, rate in rates_hz.items()}
        self._period_us = dict(self._default_us)  # as it arrives
        self._order = {name: index for index, name in enumerate(rates_hz)}
        # a heap of (due, index in the table, name): few of the streams are due at any one time
        self._due = [
            (int(phase_s * 1e6) + period, self._order[name], name)
            for name, period in self._period_us.items()
            if period > 0
        ]
        heapq.heapify(self._due)
        self.next_us = self._due[0][0] if self._due else NEVER_US

    def __contains__(self, name: str) -> bool:
        """Whether there is such a stream, on or off."""
        return name in self._default_us

    def interval_us(self, name: str) -> int:
        """The requested or configured interval."""
        if name in self._asked_us:
            return self._asked_us[name]
        rate = self._rates_hz.get(name, 0.0)
        return _CONFIGURED_US.get(rate, _interval_us(rate))

    def rate_hz(self, name: str) -> float:
        """Its rate; 0 if it is off."""
        period = self._period_us.get(name, -1)
        return 1e6 / period if period > 0 else 0.0

    def set_interval(self, name: str, interval_us: int, now_us: int) -> None:
        """-1 switches off, 0 restores the default."""
        if interval_us == 0:
            self._asked_us.pop(name, None)
            period = self._default_us[name]
        else:
            self._asked_us[name] = max(interval_us, -1)
            period = round(interval_us / self._clock_rate) if interval_us > 0 else -1
        self._period_us[name] = period
        self._due = [entry for entry in self._due if entry[2] != name]
        if period > 0:
            self._due.append((now_us + period, self._order[name], name))
        heapq.heapify(self._due)
        self.next_us = self._due[0][0] if self._due else NEVER_US

    def restart(self, now_us: int) -> None:
        """The default rates again, as after a reboot."""
        self._asked_us.clear()
        self._period_us = dict(self._default_us)
        self._due = [(now_us + us, self._order[name], name) for name, us in self._period_us.items() if us > 0]
        heapq.heapify(self._due)
        self.next_us = self._due[0][0] if self._due else NEVER_US

    def due(self, now_us: int) -> list[str]:
        """The messages to send now. A stream that fell behind by more than an interval skips."""
        names: list[str] = []
        if now_us < self.next_us:
            return names
        heap = self._due
        while heap[0][0] <= now_us:
            due, index, name = heap[0]
            period = self._period_us[name]
            following = due + period
            heapq.heapreplace(heap, (following if following > now_us else now_us + period, index, name))
            names.append(name)
        self.next_us = heap[0][0]
        return names


def _interval_us(rate_hz: float) -> int:
    return round(1e6 / rate_hz) if rate_hz > 0.0 else -1
