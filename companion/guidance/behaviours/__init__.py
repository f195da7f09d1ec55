"""Behaviours: one file each, with command and behaviour."""
