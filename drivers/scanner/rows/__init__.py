"""Slots of returns, filled by NumPy or by compiled loops."""
