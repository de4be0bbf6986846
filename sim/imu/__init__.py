"""The inertial measurement unit and its CAN frames."""
