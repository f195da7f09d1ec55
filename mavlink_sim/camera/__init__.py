"""Scenes and the camera in them: drawing, lens, sensor, depth, and where the frames go."""
