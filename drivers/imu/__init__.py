"""Drivers of inertial units, one file or package for each protocol."""
