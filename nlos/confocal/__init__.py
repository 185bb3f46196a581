"""Confocal scans of a planar wall: the light-cone transform and f-k migration.

Both see the wall as a lattice of points, each of which is its own laser spot, so that bin i holds
what lies at the distance ``d = L_i / 2``. Both turn the image of a hidden point, a hyperboloid
``d^2 = z^2 + |p - r|^2``, back into the point with Fourier transforms, at a cost that hardly
depends on the number of voxels.
"""
