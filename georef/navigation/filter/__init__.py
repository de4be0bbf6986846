"""The error-state Kalman filter and its smoother."""
