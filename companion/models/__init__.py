"""Models: which there are, fetching them, what is in one, whether its exports agree."""
