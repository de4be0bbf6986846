"""Trajectories, both complete ones and those that grow."""
