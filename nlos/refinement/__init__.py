"""Iterative refinement: the hidden volume that explains what the wall recorded.

`model` is the hybrid's way from a volume to the wall and back as a linear operator; `refine` solves
it with the solvers of `tofclip.solvers`.
"""
