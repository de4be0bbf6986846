"""Flights of the virtual aircraft, sent into a log, into files or onto wires."""
