"""Slots of returns, converted to rows by NumPy or by compiled loops."""
