"""Transform jaxprs: walk, inline, fold, hoist and partition them; identify functions by their jaxpr.

Imports `hints`, `primitive.macro` and `cache.dependency_key`. Start with `traverse`, then `partition`.
"""
