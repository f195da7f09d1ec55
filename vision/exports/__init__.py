"""Exports a checkpoint for other runtimes, as numbers of 32 bits or quantised."""
