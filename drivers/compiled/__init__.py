"""Loops compiled by numba, for logs of billions of returns; the recorder imports none of them."""
