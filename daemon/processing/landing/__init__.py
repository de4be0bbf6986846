"""Judges before landing whether a flight is complete: lines, gaps, density, calibration, base data, log."""
