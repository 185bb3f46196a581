"""Range from counted photons, up to the limit that their number sets.

Two kinds of data have an estimator each. Recovered frames carry the nearly even errors of an
inverse problem: `tofclip.lidar.depth` fits the pulse to them by least squares. The bins of a
photon-counting detector are Poisson distributed: for them the log-matched filter and the weighted
fit of this room reach the maximum likelihood. Peaks, overlapping returns and positions below a bin
are found by the same compiled steps. `PhotonDetector` takes every pixel alone, `estimate_surface`
lets neighbours lend each other their photons.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
