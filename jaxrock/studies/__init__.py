"""Questions about many responses: spectra, overturning maps, critical amplitudes, sensitivities, similarity.

Imports `responses` and `sweeps`. Start with `spectra`.
"""
