"""Velodyne spinning heads: parser, models, calibration and position packets."""
