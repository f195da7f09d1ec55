"""The command line: `mavlink-sim`."""
