"""Calibration of a camera's lens: boards, choice of views, fit, and ROS's calibration files."""
