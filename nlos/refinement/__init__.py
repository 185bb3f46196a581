"""Iterative refinement: the hidden volume that explains best what the wall recorded."""
