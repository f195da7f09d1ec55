"""The camera's gimbal: whose it is, where it is to look."""
