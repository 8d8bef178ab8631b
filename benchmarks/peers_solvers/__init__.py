"""Peers of jaxrock, each an implementation of its own, and the problems and references that compare them.

`problems`: what is solved; `reference`: with 36 digits; the other modules: one way each to solve it.
"""
