"""Cameras of compact light-field photography, one module for each kind; `light_field_camera` has
the table.
"""
