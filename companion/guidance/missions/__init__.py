"""Mission files: how one is read, and those that come along."""
