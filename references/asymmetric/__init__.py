"""References for blocks whose two sides differ, also under vertical motion: see README.md."""
