"""Arguments and results of public functions: annotations that are checked, ranges, declared parameters, tables.

Imports `status`, `compiler` and `_core`. Start with `annotations`, then `ranges` and `parameters`.
"""
