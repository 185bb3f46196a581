"""Recordings: an instrument's bytes as they came, in an HDF5 file that is whole at every moment.

The file holds the calibration and what is known about the instrument, written before anything else,
and one dataset, ``raw``, to which self-describing blocks are appended (`devices.recording.blocks`).
Nothing that was written is ever written again, except for the few numbers that say how far the
dataset reaches (`devices.recording.appendable_file`).
"""
