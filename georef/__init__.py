"""Conventions of the project on one page; docs/conventions.md has them in full.

Frames      s sensor (z along the beam at scan angle 0, x forward, y right), b body (the IMU's: x forward,
            y right, z down), l local level (north, east, down; ellipsoidal), e earth (ECEF, EPSG:4978),
            m mapping (east, north, up of a projected CRS). All are right-handed.
Rotations   active; ``rot_b_from_s`` takes s coordinates to b: ``x_b = rot_b_from_s @ x_s``, so adjacent
            frame names in a product are equal. Attitude: ``rot_l_from_b = Rz(yaw) Ry(pitch) Rx(roll)``.
Names       Arrays of coordinates end in their frame (``points_e``, ``lever_arm_b``), scalars and columns in
            their unit (``range_m``, ``roll_rad``, ``time_ns``); innovations and residuals are observed − computed.
Units       SI inside: metres, seconds, radians; degrees only at interfaces, in names that end in ``_deg``.
Time        GPS time is int64 nanoseconds since 1980-01-06T00:00:00, continuous, without leap seconds (``gps_ns``).
            Host time (``host_time_ns``) is CLOCK_MONOTONIC plus a constant of the session, int64 nanoseconds.
            Device time (``device_time_ns``) is the device's own counter in nanoseconds. None overwrites another.
Sigmas      One standard deviation.
"""
