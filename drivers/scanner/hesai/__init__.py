"""Hesai heads."""
