"""PX4's Commander: arming, modes, failsafes, and the pilot's sticks."""
