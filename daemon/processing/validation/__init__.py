"""Implements `swath validate`: tests calibrations against other logs."""
