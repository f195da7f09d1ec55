"""Sentences of an operator: read by patterns, or by a language model that calls functions."""
