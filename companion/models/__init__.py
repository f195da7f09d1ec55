"""Model files: list, download, description, comparison of exports."""
