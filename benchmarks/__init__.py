"""Programs for development: they measure what the repository claims. Not installed."""
