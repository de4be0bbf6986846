"""Laser scanners: one file a protocol."""
