"""Sets up a computer for the service: finds autopilot, cameras and the fastest runtime, and writes settings.

Nothing is sent to an autopilot, and nothing is opened that another program has open.
"""
