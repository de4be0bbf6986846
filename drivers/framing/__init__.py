"""Extracts frames from a stream of bytes: kinds of frames, their checksums, and the framer that finds them."""
