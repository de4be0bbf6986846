"""Trajectories: fixed ones and those that grow."""
