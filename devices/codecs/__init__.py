"""Codecs: the bytes of each instrument to NumPy records and back, and nothing else. See `devices.codec.Codec`."""
