"""Replaces the real asammdf in every process that the tests start.

python-can imports asammdf wherever it is installed, and pandas with it, which takes a second at each start, for a file
format that Swath does not read. An aircraft's computer does not have it; one test asks for the real one.
"""

raise ImportError("only the test that reads MF4 files has asammdf")
