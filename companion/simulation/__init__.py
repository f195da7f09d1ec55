"""The service with the simulated vehicle: `play`, `demo`, and campaigns of seeds."""
