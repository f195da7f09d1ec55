"""What is told to the world, and what the world may ask: zenoh."""
