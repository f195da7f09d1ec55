"""The vehicle: its state, commands, setpoints, and the drivers that exchange MAVLink with it."""
