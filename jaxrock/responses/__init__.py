"""What users ask of one scene: `outcome`, `simulate`, and the forces between block and ground.

Imports `engines` and `flexible`. Start with `outcome`.
"""
