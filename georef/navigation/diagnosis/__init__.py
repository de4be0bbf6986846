"""Diagnose a flight's installation and timing from its data."""
