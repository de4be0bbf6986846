"""Calibration: observations, adjustment, proof."""
