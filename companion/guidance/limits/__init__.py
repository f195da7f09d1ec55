"""What no behaviour can leave or ignore: envelope, obstacles, battery, setpoint monitor."""
