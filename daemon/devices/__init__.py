"""Devices found, identified, checked and set up."""
