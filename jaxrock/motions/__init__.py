"""Ground motions: what each must tell the engines (`motion`), pulses, records, suites, files, measures of intensity.

Imports `numerics` and `blocks`. Start with `motion`; another pulse is a file in `pulses`, another format
one in `files`.
"""
