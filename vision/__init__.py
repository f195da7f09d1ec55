"""Frames to targets: sources, detection, tracking, geometry. Knows no MAVLink, no asyncio, no zenoh."""
