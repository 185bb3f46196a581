"""Which candidates of a pixel are one surface, whose light the recovery spread over time.

The views are projections along lines within some angle of the vertical. Where a surface's lines of
equal range run level in the picture, as a table top's or a slanted roof's do, light of an instant can
move up and down along them without a view that notices. At one pixel the pulse becomes a hump, many
pulses long, on which each ripple looks like a return: none is, and their middle is.
"""

from __future__ import annotations

import numpy as np

from tofclip.compiling import compile_as_part, compile_loop

spread_part = compile_as_part(_nrt=False)

# of a candidate's light, below which its own part of the trace ends
EDGE_FRACTION = 0.1
# of the lower of two, from which the light between them says that they are one
VALLEY_FRACTION = 0.35
# distance of two humps, in sums of their deviations, up to which they are one: 1.7 if they touch
REACH_DEVIATIONS = 4.0


@compile_loop()
def join_spread(values, times, pixel, place, half, own_variance, joined, moments):
    """Number the surfaces that candidates belong to. `values` (time, pixels): light; `times` (time,);
    `pixel, place` (n,): pixel and bin of each, in the order of both; `half`: bins on either side over
    which ripples are evened out; `own_variance`: of the squared pulse. Overwritten are, of each
    candidate, `joined` (n,): the first one of its surface; and of these `moments` (3, n): sum of the
    squares of the surface's light, and by these the mean and the variance of its time.
    """
    weight, middle, variance = moments
    for k in range(place.size):
        own, here = pixel[k], place[k]
        follows = k > 0 and pixel[k - 1] == own
        ahead = k + 1 < place.size and pixel[k + 1] == own
        low = find_end(values, own, here, place[k - 1] if follows else -1, -1)
        high = find_end(values, own, here, place[k + 1] if ahead else times.size, 1)
        total, mean, square = 1e-30, 0.0, 0.0
        for t in range(low, high + 1):
            light, late = max(values[t, own], np.float32(0)), times[t] - times[here]
            light *= light * (1.0 if low < t < high else 0.5)  # its neighbour has the other half
            total, mean, square = total + light, mean + light * late, square + light * late**2
        mean /= total
        first = k
        weight[k], middle[k], variance[k] = total, times[here] + mean, square / total - mean**2
        shallow = follows and is_shallow(values, own, place[k - 1], here, half)
        while follows:
            last = joined[first - 1]
            apart = middle[first] - middle[last]
            reach = np.sqrt(max(variance[last] - own_variance, 0.0))
            reach += np.sqrt(max(variance[first] - own_variance, 0.0))
            if not shallow and apart > REACH_DEVIATIONS * reach:
                break
            total, part = weight[last] + weight[first], weight[first]
            variance[last] = weight[last] * variance[last] + part * variance[first]
            variance[last] = variance[last] / total + weight[last] * part * (apart / total) ** 2
            weight[last], middle[last] = total, middle[last] + apart * part / total
            first, shallow = last, False
            follows = first > 0 and pixel[first - 1] == own
        joined[first : k + 1] = first


@spread_part
def find_end(values, own, here, stop, step):
    """The bin of least light between `here` and `stop`, at most where hardly any is left."""
    end, least = here, values[here, own]
    enough = EDGE_FRACTION * least
    for t in range(here + step, stop, step):
        if values[t, own] < least:
            end, least = t, values[t, own]
        if least < enough:
            break
    return end


@spread_part
def is_shallow(values, own, first, last, half):
    """Whether the light between two candidates does not fall far below that of the lower one."""
    ends, least = np.inf, np.inf
    for t in range(first, last + 1):
        light = 0.0
        for s in range(max(t - half, 0), min(t + half + 1, len(values))):
            light += values[s, own]
        ends, least = min(ends, light) if t in (first, last) else ends, min(least, light)
    return least >= VALLEY_FRACTION * ends
