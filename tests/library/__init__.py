"""Tests of the public interface: `import swath`."""
