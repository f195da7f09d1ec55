"""The inputs of the failsafes."""

from __future__ import annotations

from dataclasses import dataclass

from mavlink_sim.physics.battery import BatteryWarning


@dataclass(slots=True)
class Conditions:
    """The conditions that are active now; each check sets its field.

    Attributes:
        manual_control_lost: neither a remote control nor a joystick is valid.
        ground_station_lost: no ground station's heartbeat (true until the first one).
        battery_warning: of the emptiest battery.
        offboard_signal_lost: no setpoint stream.
        geofence_breached, mission_failed, wind_exceeded, flight_time_exceeded, motor_failed: as named.
        mission_finished: the mission's last item is done.
    """

    manual_control_lost: bool = True
    ground_station_lost: bool = True
    battery_warning: BatteryWarning = BatteryWarning.NONE
    offboard_signal_lost: bool = True
    geofence_breached: bool = False
    mission_failed: bool = False
    mission_finished: bool = False
    wind_exceeded: bool = False
    flight_time_exceeded: bool = False
    motor_failed: bool = False

    def snapshot(self) -> tuple[object, ...]:
        """All fields, to compare with an earlier state."""
        return (
            self.manual_control_lost,
            self.ground_station_lost,
            self.battery_warning,
            self.offboard_signal_lost,
            self.geofence_breached,
            self.mission_failed,
            self.mission_finished,
            self.wind_exceeded,
            self.flight_time_exceeded,
            self.motor_failed,
        )
