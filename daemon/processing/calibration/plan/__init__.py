"""Implements `swath plan-calibration`: predicts what a planned flight would determine."""
