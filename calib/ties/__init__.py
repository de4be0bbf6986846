"""Tie points: intersections of planes, picked points, and markings."""
