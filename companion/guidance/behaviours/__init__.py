"""One file for each way of flying: its command and its behaviour."""
