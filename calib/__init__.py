"""Calibration: observations, the adjustment, its proof. Nothing here may import drivers, daemon or sim."""
