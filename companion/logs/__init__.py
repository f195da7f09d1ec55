"""What reads recordings: replay, the log of a flight, sightings, recorded frames."""
