"""Labelled pictures drawn from random scenes: to train with and to test with."""
