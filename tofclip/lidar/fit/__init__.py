"""The fit of pulses to a trace, below a bin, for recovered frames and for counted photons alike."""
