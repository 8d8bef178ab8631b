"""Helpers below every other package: arrays and settings of JAX, files that are whole or absent, messages, progress.

Imports nothing of the package. Start with `arrays`, then `settings`.
"""
