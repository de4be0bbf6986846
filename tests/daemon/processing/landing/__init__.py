"""Tests of the verdict before landing."""
