"""Measurements for development, not installed with the packages."""
