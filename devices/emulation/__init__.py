"""Emulated instruments: what they share, the scenes before them, and one chapter for each."""
