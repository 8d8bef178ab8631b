"""The series engine: Taylor steps that are exact to rounding.

Imports the modules of `engines`. Start with `accurate`, one step of one lane. `fast` does most steps of many lanes,
`event_free_step` those without events more cheaply, and `fast_loop` is their loop.
"""
