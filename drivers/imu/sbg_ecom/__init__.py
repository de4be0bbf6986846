"""SBG Systems inertial units: sbgECom logs."""
