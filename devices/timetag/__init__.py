"""The FX2 time tagger (S. V. Polyakov, B. Gamari): four inputs, a 36-bit counter, USB 2.0 bulk
transfers.

Gateware and protocol are public; this is a driver down to the wire.
"""
