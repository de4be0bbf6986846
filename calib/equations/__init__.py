"""Rows, normal equations, their solution, and measures of its quality."""
