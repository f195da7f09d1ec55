"""Measurements on this machine, and flights flown many times over."""
