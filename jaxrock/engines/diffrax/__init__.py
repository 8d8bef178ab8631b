"""The diffrax engine: one `diffrax.diffeqsolve` for every smooth arc of a rocking block.

Imports the modules of `engines`. Start with `guards`, an arc and the events that end it, then `arcs`.
"""
