"""Accelerograms in files: one module for each format, and `reading`, which finds the format and reads.

Imports `motions.record`. Start with `format`, then `reading`. A new format is a module like `smc`, and a line in the
table of `reading`.
"""
