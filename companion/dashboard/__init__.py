"""The dashboard: a web page of one vehicle, served by a zenoh client in a process of its own."""
