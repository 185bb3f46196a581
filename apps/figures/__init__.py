"""The pictures that verbs draw, as matplotlib figures. Import what you draw with: matplotlib is
slow to load.
"""
