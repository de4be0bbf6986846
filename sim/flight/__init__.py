"""The path, speed and attitude of the aircraft."""
