"""Implements `swath calibrate` and `swath plan-calibration`."""
