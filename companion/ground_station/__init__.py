"""The vehicle's cameras for ground stations: the MAVLink camera protocol, video, and warnings."""


class GroundStationError(ValueError):
    """The settings cannot be used here. The message is one line."""
