"""Velodyne heads."""
