"""Turns logs into points: feed, jobs, workers."""
