"""How probably a rock topples: fragilities, fitted or simulated, hazard curves, and files of OpenQuake.

Imports `studies`, `responses`, `sweeps`. Start with `fragility`, then `curves`.
"""
