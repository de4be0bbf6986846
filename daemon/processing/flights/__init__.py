"""Finds out which logs and which trajectory belong together."""
