"""The inertial measurement unit, its errors and its CAN frames."""
