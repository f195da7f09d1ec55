"""Limits that hold for every behaviour: envelope, obstacles, battery, setpoint monitor."""
