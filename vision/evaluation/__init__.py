"""Judging a detector on labelled photographs: data sets read, misses shown."""
