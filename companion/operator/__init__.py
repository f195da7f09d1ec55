"""The operator's doors on the board itself."""
