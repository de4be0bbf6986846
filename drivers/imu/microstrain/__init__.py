"""MicroStrain (LORD, HBK) inertial units: MIP packets."""
