"""Scenes and their camera: drawing, lens, sensor, depth, and outputs."""
