"""A plan's coverage and picture."""
