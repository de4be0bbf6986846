"""Inertial units: one file a protocol."""
