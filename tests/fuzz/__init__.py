"""Feeds improbable inputs, made from a seed and a mutation, to everything that reads foreign bytes.

`parsers` (every driver, found by what it declares), `logs` (reader and recovery), `files` (captures, configuration),
`followed` (a log that grows, and its sign), `exports` (a log as other people's files, and back), `asked` (operators,
casters, receivers that answer), `device_files` and `rasters` (files that configurations name), `office` and
`office_files` (what people bring to the office's commands);
`engine` lets Hypothesis run them. ``python -m tests.fuzz`` is the long run, `test_fuzz` the short one of the suite.
"""
