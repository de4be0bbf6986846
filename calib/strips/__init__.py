"""Strips compared: differences, signatures of causes, corrections, accuracy standards."""
