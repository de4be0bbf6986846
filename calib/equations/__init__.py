"""Rows, normal equations, their solution, and what these say of quality."""
