"""Windows of neighbouring measurements, under which the highest value is looked for."""

WINDOW = 4
"""Measurements under a window: a pair of pairs."""

FRACTIONS = 4
"""Parts into which the way from a measurement to the next one is cut."""

FRACTION_SLACK = 0.01
"""By which each part reaches into its neighbours, relative to its length: pixels whose fractions are
alike but for rounding share a window."""
