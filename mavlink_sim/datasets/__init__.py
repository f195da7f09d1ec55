"""Labelled images of random scenes, for training and testing."""
