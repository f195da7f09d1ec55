"""The vehicle: its state, what we ask of it, and the drivers that speak to it."""
