"""Drivers of laser scanners, one file or package for each protocol."""
