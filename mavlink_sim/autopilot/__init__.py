"""PX4's Commander: arming, modes, failsafes, manual control."""
