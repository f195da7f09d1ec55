"""How often each kind of link gets each message.

`ONBOARD_RATES_HZ` were measured on a PX4's onboard link, `GCS_RATES_HZ` on its ground station's.
"""

from __future__ import annotations

import heapq

NEVER_US = 2**63

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
    "GPS_GLOBAL_ORIGIN": 0.0,  # on change alone
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
}

# What comes on top with a remote control or a gimbal, by PX4's source: (onboard link, any other link).
EQUIPMENT_RATES_HZ: dict[str, tuple[float, float]] = {
    "RC_CHANNELS": (20.0, 5.0),
    "GIMBAL_DEVICE_ATTITUDE_STATUS": (5.0, 5.0),
    "GIMBAL_MANAGER_STATUS": (0.5, 0.5),
    "MOUNT_ORIENTATION": (10.0, 10.0),
}


class Streams:
    """The schedule of one link. Intervals are microseconds; a stream that is off has interval -1.

    `next_us` is when something is due again: before that, `due` need not be asked.
    """

    def __init__(self, rates_hz: dict[str, float], phase_s: float = 0.0) -> None:
        self._default_us = {name: _interval_us(rate) for name, rate in rates_hz.items()}
        self._interval_us = dict(self._default_us)
        self._order = {name: place for place, name in enumerate(rates_hz)}
        # a heap of (due, place in the table, name): few of the streams are due at any one time
        self._due = [
            (int(phase_s * 1e6) + interval, self._order[name], name)
            for name, interval in self._interval_us.items()
            if interval > 0
        ]
        heapq.heapify(self._due)
        self.next_us = self._due[0][0] if self._due else NEVER_US

    def __contains__(self, name: str) -> bool:
        """Whether there is such a stream, on or off."""
        return name in self._default_us

    def interval_us(self, name: str) -> int:
        return self._interval_us.get(name, -1)

    def set_interval(self, name: str, interval_us: int, now_us: int) -> None:
        """-1 switches off, 0 restores the default."""
        interval = self._default_us[name] if interval_us == 0 else max(interval_us, -1)
        self._interval_us[name] = interval
        self._due = [entry for entry in self._due if entry[2] != name]
        if interval > 0:
            self._due.append((now_us + interval, self._order[name], name))
        heapq.heapify(self._due)
        self.next_us = self._due[0][0] if self._due else NEVER_US

    def restart(self, now_us: int) -> None:
        """The default rates again, as after a reboot."""
        self._interval_us = dict(self._default_us)
        self._due = [
            (now_us + us, self._order[name], name) for name, us in self._interval_us.items() if us > 0
        ]
        heapq.heapify(self._due)
        self.next_us = self._due[0][0] if self._due else NEVER_US

    def due(self, now_us: int) -> list[str]:
        """The messages to send now. A stream that fell behind by more than an interval skips."""
        names: list[str] = []
        if now_us < self.next_us:
            return names
        heap = self._due
        while heap[0][0] <= now_us:
            due, place, name = heap[0]
            interval = self._interval_us[name]
            following = due + interval
            heapq.heapreplace(heap, (following if following > now_us else now_us + interval, place, name))
            names.append(name)
        self.next_us = heap[0][0]
        return names


def _interval_us(rate_hz: float) -> int:
    return round(1e6 / rate_hz) if rate_hz > 0.0 else -1
