"""PX4's Navigator: plans, how they are flown, the geofence, the way home."""
