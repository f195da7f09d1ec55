"""The vehicle's body: how it moves, what it senses of that, its battery and its gimbal."""
