"""Tie points: intersections of planes, picked points, markings."""
