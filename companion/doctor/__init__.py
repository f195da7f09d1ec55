"""What is wrong on this computer and with a running service: `companion doctor`, `companion status`.

Each file holds one group of checks: small functions over facts, which a test makes. `examine.py` collects the
facts, at most 10 s, and runs all of them.
"""
