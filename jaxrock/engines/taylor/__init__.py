"""The series engine: Taylor steps that are exact to rounding.

Imports the modules of `engines`. Start with `careful`, one step of one lane. `fast` is the same for many
lanes, `glide` what it costs where nothing happens, and `follow` their loop.
"""
