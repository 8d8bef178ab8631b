"""Forward mode through a jaxpr, and values with a rule for their tangents.

Imports `jaxpr` and `primitive.lane_function`. Start with `derivatives`, then `jvp_jaxpr` and `custom_tangent`.
"""
