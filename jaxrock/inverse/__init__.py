"""From rocks, or a measured history, back to motions and blocks: likelihood, estimates, samples, allowed motions.

Imports `studies` and `responses`. Start with `likelihood`, then `estimate`.
"""
