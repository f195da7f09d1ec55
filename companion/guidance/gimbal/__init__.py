"""The camera's gimbal: control, pointing, sweeping, tracking."""
