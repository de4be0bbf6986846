"""The surface that points lie on, estimated from the points themselves, and what a beam's footprint does on it."""
