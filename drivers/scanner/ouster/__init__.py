"""Ouster spinning heads: parser, metadata, layouts and IMU packets."""
