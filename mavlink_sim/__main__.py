"""`python -m mavlink_sim` is `mavlink-sim`."""

from vision.loading import uncollected

with uncollected():
    from mavlink_sim.cli import main

if __name__ == "__main__":
    main()
