"""Multiple vehicles: poses, separation, formation membership and slot assignment."""
