"""Bodies that rock: rigid ones, symmetric or not, flexible columns, and the law by which an impact slows them.

Imports `numerics`. Start with `rigid`; another law of restitution is a class like those in `restitution`.
"""
