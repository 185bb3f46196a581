"""Instruments made of software, which stand where the real ones would: behind the USB, or behind a
TCP port.

The drivers do not know the difference; all of their code runs.
"""
