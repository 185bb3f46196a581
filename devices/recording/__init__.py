"""Recordings: an instrument's bytes as they came, in a file that stays readable whatever happens.

A recording is a plain sequence of blocks (`devices.recording.read`). Each block carries its own
length, number and checksums, and is written once and never changed. So a program that is killed
loses nothing that it had written, and a damaged byte costs the one block that it lies in.

::

    HEAD HEAD PIECE PIECE ... [HEAD] ... PIECE HEAD END

The head says what the instrument is and holds its calibration. It comes twice at the front, again
every 64 MiB, and once more before the end, so that no single damage makes the pieces meaningless.
There is no index: reading the headers of ten thousand pieces takes some 30 ms.

The name of a recording ends in ``.h5`` for the sake of existing scripts; what the file is, is
decided by its content. Recordings of version 0.1.0 were HDF5 files around the same kind of blocks.
They are read by finding the blocks in them.
"""
