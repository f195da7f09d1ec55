"""The vehicles, one for each firmware, and the world around them."""
