"""What the service uses of the computer: clocks, tasks, child processes, journal, limits on data of peers."""
