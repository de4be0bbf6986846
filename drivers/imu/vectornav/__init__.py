"""VectorNav inertial units: binary output messages, by field."""
