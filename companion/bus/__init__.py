"""Published topics and received commands: zenoh."""
