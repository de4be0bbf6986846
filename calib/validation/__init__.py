"""Calibrations compared with one another and with later flights."""
