"""The fit of returns on an uneven time axis, and of those at the ends of an even one, where not all
bins of the table (`tofclip.lidar.search.table_fit`) are there: `tofclip.lidar.pulse_fit`, trace by
trace.
"""

from __future__ import annotations

from tofclip.lidar.detection import MAX_FIT_ROUNDS
from tofclip.lidar.pulse_fit import (
    EVEN_VARIANCE,
    measure_returns,
    refine_returns,
    sort_rows,
)
from tofclip.lidar.search.candidates import (
    FIRST_OFFSET,
    NEEDS_EXACT_FIT,
    NOISE,
    PEAK_BIN,
    TRACE,
)
from tofclip.lidar.search.peaks import search_step


@search_step
def fit_returns_exactly(
    traces,
    pixels,
    times,
    moments,
    least,
    windows,
    candidates,
    listed,
    pulse,
    estimates,
    profile,
    found,
    counts,
):
    """Fit and measure the returns of the traces that the table does not do.

    `traces` (n, bins); `pixels` (n,): number of the pixel to which each trace belongs; `times`
    (bins,): seconds, increasing; `moments` (n, 2): mean and standard deviation of the bins without
    a return; `least`: standard deviations that a return's response must exceed; `windows` (bins,
    4): see `tofclip.lidar.search.windows.list_windows`; `candidates` (room, CANDIDATE_COLUMNS):
    those of one trace side by side; see `tofclip.lidar.search.candidates`; `listed`: how many;
    `pulse` (curve, scale): see `tofclip.lidar.pulse_fit`; `estimates` (most returns, 5):
    overwritten; `profile` (bins, 3): overwritten; `found` (all pixels, most returns, 3):
    overwritten where `counts` is `NEEDS_EXACT_FIT`: instant, s, sum of the fitted pulse over the
    bins, standard deviation of the instant, s; nearest first; `counts` (all pixels,): number of
    returns of each pixel.
    """
    curve, scale = pulse
    start = 0
    while start < listed:
        place, end = int(candidates[start, TRACE]), start
        pixel, trace, background = pixels[place], traces[place], moments[place, 0]
        while end < listed and int(candidates[end, TRACE]) == place:
            j, guess = int(candidates[end, PEAK_BIN]), estimates[end - start]
            width = times[j + 1] - times[j]
            # from the beginning: what does not converge in so many steps is not given more of them
            guess[0] = times[j] + candidates[end, FIRST_OFFSET] * width
            guess[1] = max(trace[j] - background, 0.0)
            guess[2] = windows[j, 0]
            guess[3] = windows[j, 1]
            end += 1
        if counts[pixel] == NEEDS_EXACT_FIT:
            estimate, noise = estimates[: end - start], candidates[start, NOISE]
            refine_returns(
                trace, times, background, curve, scale, estimate, EVEN_VARIANCE, MAX_FIT_ROUNDS
            )
            number = measure_returns(
                trace,
                times,
                background,
                noise,
                curve,
                scale,
                estimate,
                least * noise,
                profile,
                found[pixel],
            )
            sort_rows(found[pixel], number)
            counts[pixel] = number
        start = end
