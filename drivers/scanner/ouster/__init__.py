"""Ouster heads."""
