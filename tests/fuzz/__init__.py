"""Feeds improbable inputs, made from a seed and a mutation, to everything that reads foreign bytes.

`parsers` has every driver, found by its declaration, `logs` the reader and the recovery, `files` captures and
configurations, `followed` a growing log and its sign, `exports` a log as other programs' files and back, `asked`
operators, casters and receivers that answer, `device_files` and `rasters` files that configurations name, `office` and
`office_files` what people bring to the office's commands. `engine` lets Hypothesis run them. ``python -m tests.fuzz``
is the long run, `test_fuzz` the short one of the suite.
"""
