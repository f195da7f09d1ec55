"""Geometry without a vehicle: fences, formations, rows of points."""
