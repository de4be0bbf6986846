"""Compute the trajectory from inertial samples and GNSS: strapdown, error-state filter, smoother, alignment.

Frames and signs are those of CONVENTIONS: e is ECEF, l north, east, down, b the body; rotations are active, ``x_e =
rot_e_from_b @ x_b``. Errors are true − computed, so that a correction is added:

    position, velocity, biases, scales   true = computed + error
    attitude                             rot_e_from_b true = exp([ψ]×) · computed, ψ in e, rad

Innovations are observed − computed. Sensors: measured = (1 + scale) · true + bias, noise aside.
"""
