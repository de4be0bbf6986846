"""Validation: comparison of calibrations with one another and with later flights."""
