"""Displays the state of a recorder."""
