"""The aircraft's path, speed and attitude."""
