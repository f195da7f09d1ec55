"""`python -m mavlink_sim` is `mavlink-sim`."""

from vision.gc_pause import gc_paused

with gc_paused():
    from mavlink_sim.cli.main import main

if __name__ == "__main__":
    main()
