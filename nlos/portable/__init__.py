"""Imaging on the arrays of other libraries and devices: anything that follows the array API standard.

A capture whose signal is an array of PyTorch, CuPy or another such library is imaged by that
library, where the signal lives, and gives a volume there. What is planned on small arrays (bands,
windows, plane waves, the splitting of illumination and relief) is planned by the same code as for
NumPy; here is only what costs time.
"""
