"""Initial attitude from inertial data and positions."""
