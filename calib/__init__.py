"""Calibration: observations, adjustment and proof. This package must not import drivers, daemon or sim."""
