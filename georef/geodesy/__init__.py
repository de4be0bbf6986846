"""The ellipsoid and its gravity; rotations, quaternions and vectors."""
