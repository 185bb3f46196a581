"""Captures in the files of other laboratories and programs, turned once, at this border, into
`nlos.Capture`.
"""

from nlos.io.format_detection import read_capture

__all__ = ["read_capture"]
