"""What PX4 calls things: its flight modes, its parameters and their defaults."""
