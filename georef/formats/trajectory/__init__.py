"""Trajectory files: their columns, CSV, and the choice of a reader by what a file is."""
