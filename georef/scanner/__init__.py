"""The scanner's model: calibration, beams, mount, covariance, pulses in air."""
