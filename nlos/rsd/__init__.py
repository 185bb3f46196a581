"""Rayleigh-Sommerfeld diffraction from one plane to many."""
