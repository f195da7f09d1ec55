"""The one memory of objects: what the steering camera shows, as values that are flown to and published."""
