"""Vehicles in real time, over UDP."""
