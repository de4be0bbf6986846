"""Drivers of GNSS receivers, one file or package for each protocol."""
