"""The battery: discharge, PX4's measurements of it, and the warnings.

Two models, selected as on a real vehicle by BAT1_CAPACITY:

* unknown (negative, the default): PX4's simulated battery. It is discharged within SIM_BAT_DRAIN seconds of
  armed time, never below SIM_BAT_MIN_PCT, and full again when disarmed. There is no current sensor.
* in mAh: a battery with a current sensor. The current follows from the thrust, the voltage sags by
  BAT1_R_INTERNAL per cell, and the used charge is not restored.
"""

from __future__ import annotations

import math
from enum import IntEnum

from mavlink_sim.physics.airframe import GRAVITY_MPS2
from mavlink_sim.px4.parameters import Parameters

SUPPLY_CHECK_OFF = 894281  # CBRK_SUPPLY_CHK's key
CELL_FILTER_S = 1.0  # as recorded: the reported charge lags the voltage by about a second
SIMULATED_CURRENT_A = -1.0  # PX4's simulated battery has no sensor; this is what it reports
DEFAULT_CELL_RESISTANCE_OHM = 0.005  # PX4's first estimate
AVIONICS_CURRENT_A = 0.5
CURRENT_AVERAGE_S = 50.0  # the average from which the remaining time is computed


class BatteryWarning(IntEnum):
    """PX4's warning levels; one more is MAV_BATTERY_CHARGE_STATE."""

    NONE = 0
    LOW = 1
    CRITICAL = 2
    EMERGENCY = 3


class Battery:
    """One battery.

    Attributes:
        charge: the true charge, 0..1.
        remaining: the autopilot's estimate of it, 0..1.
        volts: under load, of all cells. current_a: as measured, -1 without a sensor.
        discharged_mah: used since the start.
        forced_charge: the true charge set by a fault; None without one. While it is set, warnings are active
            whatever CBRK_SUPPLY_CHK is.
        forced_charge_holds: it is not discharged further.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._revision = -1
        self.charge = 1.0
        self.forced_charge: float | None = None
        self.forced_charge_holds = False
        self.current_a = SIMULATED_CURRENT_A
        self.discharged_mah = 0.0
        self._load()
        self.volts = self._cells * self._charged_v
        self._cell_v = self._charged_v - 0.01 * (self._charged_v - self._empty_v)  # the filter is not settled
        self.remaining = self._voltage_charge()
        self._average_current_a = self._hover_current_a

    def _load(self) -> None:
        value = self._parameters.number
        self._revision = self._parameters.revision
        self._cells = max(int(value("BAT1_N_CELLS")), 1)
        self._empty_v, self._charged_v = value("BAT1_V_EMPTY"), value("BAT1_V_CHARGED")
        self._capacity_mah = value("BAT1_CAPACITY")
        resistance = value("BAT1_R_INTERNAL")
        self._resistance_ohm = DEFAULT_CELL_RESISTANCE_OHM if resistance < 0.0 else resistance
        self._hover_current_a = max(value("BAT_AVRG_CURRENT"), 0.1)
        self._drain_s = self._parameters.positive("SIM_BAT_DRAIN")
        self._lowest = min(max(value("SIM_BAT_MIN_PCT") / 100.0, 0.0), 1.0)
        self._thresholds = (value("BAT_LOW_THR"), value("BAT_CRIT_THR"), value("BAT_EMERGEN_THR"))

    @property
    def connected(self) -> bool:
        return int(self._parameters.number("SIM_BAT_ENABLE")) != 0

    @property
    def has_current_sensor(self) -> bool:
        return self._capacity_mah > 0.0

    @property
    def warning(self) -> BatteryWarning:
        """By BAT_LOW_THR, BAT_CRIT_THR and BAT_EMERGEN_THR; as BATTERY_STATUS reports it."""
        low, critical, emergency = self._thresholds
        if self.remaining < emergency:
            return BatteryWarning.EMERGENCY
        if self.remaining < critical:
            return BatteryWarning.CRITICAL
        return BatteryWarning.LOW if self.remaining < low else BatteryWarning.NONE

    @property
    def checked_warning(self) -> BatteryWarning:
        """The warning that arming checks and failsafes act on: none while the battery is not checked."""
        return self.warning if self.is_checked and self.connected else BatteryWarning.NONE

    @property
    def is_checked(self) -> bool:
        """Not while CBRK_SUPPLY_CHK is 894281, as in SIH; a fault of the battery is checked all the same."""
        return (
            self.forced_charge is not None
            or int(self._parameters.number("CBRK_SUPPLY_CHK")) != SUPPLY_CHECK_OFF
        )

    @property
    def charge_state(self) -> int:
        """MAV_BATTERY_CHARGE_STATE."""
        return 1 + int(self.warning)

    @property
    def time_remaining_s(self) -> int:
        """At the average current; 0 if unknown."""
        if not self.has_current_sensor:
            return 0
        hours = self.remaining * self._capacity_mah / 1000.0 / max(self._average_current_a, 0.01)
        return max(int(hours * 3600.0), 1)

    @property
    def system_status(self) -> tuple[int, int, int]:
        """Millivolts, centiamperes and percent as SYS_STATUS has them (percent is rounded up there)."""
        if not self.connected:
            return 65535, -1, -1
        return round(self.volts * 1000), round(self.current_a * 100), math.ceil(self.remaining * 100 - 1e-6)

    def step(self, dt_s: float, armed: bool, thrust_mps2: float) -> None:
        """Advance by `dt_s`. `thrust_mps2`: the collective thrust per mass that the motors give."""
        if self._revision != self._parameters.revision:
            self._load()
        if self.has_current_sensor:
            self._discharge(dt_s, armed, thrust_mps2)
        else:
            self.current_a = SIMULATED_CURRENT_A
            self.charge = max(self.charge - dt_s / self._drain_s, self._lowest) if armed else 1.0
            if armed:
                self._use_forced(dt_s / self._drain_s)
        cell = self._cell_under_no_load()
        load_a = max(self.current_a, 0.0)
        self.volts = self._cells * (cell - load_a * self._resistance_ohm)
        self.discharged_mah += self.current_a * dt_s / 3.6
        self._cell_v += (cell - self._cell_v) * min(1.0, dt_s / (CELL_FILTER_S + dt_s))
        self.remaining = self._voltage_charge()

    def settle(self) -> None:
        """Set the autopilot's estimate to the true charge."""
        self._cell_v = self._cell_under_no_load()
        self.volts = self._cells * self._cell_v
        self.remaining = self._voltage_charge()

    def _cell_under_no_load(self) -> float:
        charge = self.charge if self.forced_charge is None else self.forced_charge
        return self._empty_v + charge * (self._charged_v - self._empty_v)

    def _discharge(self, dt_s: float, armed: bool, thrust_mps2: float) -> None:
        # a propeller's power grows with the thrust to the power of 3/2; BAT_AVRG_CURRENT is that of hovering
        motors = self._hover_current_a * (max(thrust_mps2, 0.0) / GRAVITY_MPS2) ** 1.5 if armed else 0.0
        self.current_a = AVIONICS_CURRENT_A + motors
        used = self.current_a * dt_s / 3.6 / self._capacity_mah
        self.charge = max(self.charge - used, 0.0)
        self._use_forced(used)
        if armed:
            blend = min(1.0, dt_s / CURRENT_AVERAGE_S)
            self._average_current_a += (self.current_a - self._average_current_a) * blend

    def _use_forced(self, used: float) -> None:
        if self.forced_charge is not None and not self.forced_charge_holds:
            self.forced_charge = max(self.forced_charge - used, 0.0)

    def _voltage_charge(self) -> float:
        span = max(self._charged_v - self._empty_v, 0.01)
        return min(max((self._cell_v - self._empty_v) / span, 0.0), 1.0)
