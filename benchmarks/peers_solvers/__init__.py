"""Peers of jaxrock: one way each to solve the problems of `references.peer_problems`, and the report of them."""
