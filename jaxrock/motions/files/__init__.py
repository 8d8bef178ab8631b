"""Accelerograms in files: one module for each format, and `reading`, which finds the format and reads.

Imports `motions.record`. Start with `reading`; another format is a module like `at2`, and its line in `reading`.
"""
