"""PX4's flight modes, and its parameters with their defaults."""
