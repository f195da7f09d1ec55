"""Vehicles near each other: poses, separation, who is in a formation, who takes which slot."""
