"""Captures in the files of other laboratories and programs, turned once, at this border, into
`nlos.Capture`.
"""

from nlos.io.format_detection import READERS, read_capture

register_reader = READERS.register

__all__ = ["read_capture", "register_reader"]
