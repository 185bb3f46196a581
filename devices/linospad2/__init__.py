"""LinoSPAD2, a line of 256 single-photon detectors that stamps every photon with its time of
arrival.

The data format is public, the board's USB commands are not: recordings are read and simulated, no
board is driven.
"""
