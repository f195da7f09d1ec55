"""From what is seen to where to go: behaviours, limits, and the pilot that runs one behaviour at a time."""
