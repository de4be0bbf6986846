"""Implements `swath georef`: from logs to point files."""
