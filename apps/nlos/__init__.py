"""Imaging around corners for the command line: settings, defaults, measures."""
