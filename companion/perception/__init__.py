"""The perception worker process, its supervisor in the service, and the cameras' results."""
