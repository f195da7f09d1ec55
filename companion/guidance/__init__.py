"""From what is seen to where to go: behaviours, limits, and the core that steps one behaviour at a time."""
