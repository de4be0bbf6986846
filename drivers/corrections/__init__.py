"""Corrections of base stations: one file a protocol."""
