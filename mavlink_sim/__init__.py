"""A MAVLink vehicle to fly against: PX4-like, in Python, with a camera. Imports nothing of `companion`."""
