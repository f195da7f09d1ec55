"""Networks exported by other programs: recognised by their metadata and shapes, run, and decoded to boxes."""
