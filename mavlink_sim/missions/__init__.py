"""PX4's Navigator: plans, mission flight, the geofence, the return."""
