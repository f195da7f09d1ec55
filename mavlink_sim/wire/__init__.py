"""MAVLink as bytes: messages and their packing, sockets, signing, rates, and what a bad link does to them."""
