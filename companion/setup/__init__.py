"""Sets up a computer: finds what settings need and writes them, and installs the service of systemd.

Nothing is sent to an autopilot, and nothing is opened that another program has open.
"""
