"""Replaces the real asammdf in every process that the tests start.

python-can imports asammdf wherever it is installed, and pandas with it, which takes a second at each start, for a file
format that only `swath import` reads. An aircraft's computer does not have it; two tests ask for the real one.
"""

raise ImportError("only tests that read MF4 files have asammdf")
