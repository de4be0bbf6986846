"""Tests beside other programs: gpsd, and the reader of Foxglove's viewer (``make test-peers``)."""
