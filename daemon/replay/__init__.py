"""A log's units, and their way back onto wires."""
