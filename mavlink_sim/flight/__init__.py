"""PX4's controllers, and the flight tasks of the modes."""
