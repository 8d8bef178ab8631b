"""The series engine: Taylor steps that are exact to rounding.

Imports the modules of `engines`. Start with `careful`, one step of one lane. `fast` does most steps of many lanes,
`glide` those without events more cheaply, and `follow` is their loop.
"""
