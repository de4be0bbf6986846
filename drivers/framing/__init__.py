"""From a stream of bytes to frames: kinds of frames, their checksums, and the framer that finds them."""
