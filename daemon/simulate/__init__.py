"""The virtual aircraft into a log, files or onto wires."""
