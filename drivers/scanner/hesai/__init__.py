"""Hesai spinning heads: parser, models and GPS data packets."""
