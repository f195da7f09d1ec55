"""The operator's interfaces on the board: console, log output, metrics."""
