"""Files of our own: HDF5 records that name their units and axes, and writing that is all or nothing.

A *record* is a tree of named arrays. Each array carries its unit and the names of its axes; the root carries what
kind of thing it is and where it came from. Every class that can be saved turns itself into a `Record` and back, so
that the layout of the file is decided here and nowhere else.
"""

from tofclip.storage.files import SIGNATURE, atomic_path, one_line, reading, remove_leftovers
from tofclip.storage.origin import provenance, sha256_of
from tofclip.storage.record import Field, Record, Scalar

__all__ = [
    "SIGNATURE",
    "Field",
    "Record",
    "Scalar",
    "atomic_path",
    "one_line",
    "provenance",
    "reading",
    "remove_leftovers",
    "sha256_of",
]
