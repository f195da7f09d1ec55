"""How each mode flies: PX4's controllers, and the flight tasks that ask something of them."""
