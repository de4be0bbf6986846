"""Planes for the calibration: search, matching and fit."""
