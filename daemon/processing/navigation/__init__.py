"""Navigates logs: from their records to a trajectory."""
