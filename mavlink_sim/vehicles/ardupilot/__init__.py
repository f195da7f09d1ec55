"""An ArduPilot Copter: its differences on the same airframe, estimator, links and clock as the PX4-like
vehicle.

`CopterVehicle` (`copter.py`) is the vehicle. Everything specific to Copter 4.5 is in this package, from
ArduPilot's public documentation and the behaviour of its released versions:

* modes, arming and texts: `autopilot.py`, `modes.py`
* GUIDED and its setpoints: `guided.py`, `targets.py`
* LAND with precision landing, RTL: `landing.py`
* commands, streams, telemetry, parameters: `commands.py`, `streams.py`, `telemetry.py`, `parameters.py`

Not simulated: missions and AUTO (refused as without a mission), rally points, FTP, logs, terrain, the polygon
fence, SIMPLE modes, arming by stick gesture, mode switches on channels, battery failsafe actions, gimbals and
cameras, the jerk limits of ArduPilot's S-curves, SET_ATTITUDE_TARGET, `GUID_OPTIONS`, and its inner loops:
position, attitude and rates are controlled by the same loops as the PX4-like vehicle's, within ArduPilot's
speeds and accelerations.
"""
