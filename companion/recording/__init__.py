"""Recordings of flights in MCAP: writing, reading, and the values of guidance in them."""


class RecordingError(ValueError):
    """A recording cannot be written, read or served. The message is one line."""


# Beginnings of what the recorder says when all is well.
RECORDING, RECORDED = "recording to ", "recorded "
