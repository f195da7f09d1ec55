"""Missions: file format, sequencing, and the bundled mission files."""
