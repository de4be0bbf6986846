"""Comparison of strips: differences, signatures of causes, corrections, accuracy standards."""
