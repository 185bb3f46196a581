"""Seeing through occluders, shown: scenes, the experiment, and probes of what is hidden."""
