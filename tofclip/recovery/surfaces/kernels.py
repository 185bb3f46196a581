"""The compiled products of the surface model: amplitudes to a raw streak image, and back.

Light of one surface point falls, in each view, on a few columns of the slit and on the rows of its
pulse. All points of a view have the same pulse, so that their light is first put between rows by
three samples of a quadratic B-spline, and the rows are then smoothed with the rest of the pulse.
Sum, middle and variance of such samples do not depend on where between two rows the point lies
(M. Unser, IEEE Signal Process. Mag. 16(6), 22, 1999), and what is higher is gone after a pulse of a
row or more. Three samples and one smoothing stand for the eleven or more of the pulse itself.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tofclip.compiling import ONE, SUMS_IN_ANY_ORDER, compile_loop

Image = NDArray[np.float32]

fast_loop = compile_loop(fastmath=True)

SPLINE_SAMPLES, SLIT_PIXELS = 3, 4  # on which a part of a pixel is spread
TWO, THREE = np.uintp(2), np.uintp(3)
LEAST_SPREAD = 1e-3  # px, of a view whose lines are upright


# what a step that is too long leads to may be at no row at all, and is dark
@compile_loop(fastmath=SUMS_IN_ANY_ORDER)
def split_between_rows(row, share, margin, first, shares, reached):
    """Put the `share` (places,) of light at each position, (places,), between rows: the first of three,
    and samples of the quadratic B-spline there, (places, 3). What misses all rows, and a margin before and
    behind them, is dark, and lies where others do. `reached`: those rows, which light is put into.
    """
    last = reached.size - margin - SPLINE_SAMPLES
    lowest, highest = last, -margin
    for place in range(row.size):
        where = min(max(row[place], -margin - SPLINE_SAMPLES), last + SPLINE_SAMPLES)
        middle = math.floor(where + 0.5)
        off, top, light = where - middle, int(middle) - 1, share[place]
        first[place] = top
        if -margin < top < last:
            lowest, highest = min(lowest, top), max(highest, top)
        else:
            light = np.float32(0)
        shares[place, 0] = light * (0.5 * (0.5 - off) ** 2)
        shares[place, 1] = light * (0.75 - off * off)
        shares[place, 2] = light * (0.5 * (0.5 + off) ** 2)
    for place in range(row.size):
        first[place] = min(max(first[place], lowest), highest)
        for sample in range(SPLINE_SAMPLES):
            reached[first[place] + margin + sample] = True


@fast_loop
def split_over_slit(position, width, height, tangent, columns, first, shares):
    """Share of parts of picture pixels that falls on each slit pixel, (parts, 4), from `first` on; nothing of
    parts that are farther from its `columns` than they reach. A part is a rectangle, px: its height spreads it
    by the tangent of the line's angle, so that its light on the slit is a trapezium, whose integral is made of
    four parabolas.
    """
    for part in range(position.size):
        across, spread = width[part], max(math.fabs(tangent) * height[part], LEAST_SPREAD)
        wide, narrow = 0.5 * (across + spread), 0.5 * math.fabs(across - spread)
        place = min(max(position[part], -SLIT_PIXELS), columns + SLIT_PIXELS)
        start = math.floor(place - wide + 0.5)
        first[part] = start
        light = 0.5 / (across * spread) if place == position[part] else 0.0
        before = 0.0
        for slit in range(SLIT_PIXELS):
            edge = start + slit + 0.5 - place
            upto = max(edge + wide, 0.0) ** 2 - max(edge + narrow, 0.0) ** 2
            upto += max(edge - wide, 0.0) ** 2 - max(edge - narrow, 0.0) ** 2
            upto *= light
            shares[part, slit] = upto - before
            before = upto


@fast_loop
def add_light(lights, shares, starts, row, row_shares, column, slit_shares, above, before, images):
    """Add the light of surface points, (n, points), to n images of a view, (n, rows, columns); all of it
    must fall inside. `shares` (points,): what each of a point's places has of it; `starts` (points + 1,):
    first place of each; `row, column` (places,): first of those that a place reaches, shares there
    (places, 3) and (places, 4); `above, before`: the images' first ones.
    """
    for number in range(lights.shape[0]):
        image, own = images[number], lights[number]
        for point in range(own.size):
            # most points of a volume are dark
            if own[point] == 0:
                continue
            light = own[point] * shares[point]
            for place in range(starts[point], starts[point + 1]):
                # without a sign, for which an index would be looked at whether it counts from the end
                top, left = np.uintp(row[place] - above), np.uintp(column[place] - before)
                a, b = slit_shares[place, 0], slit_shares[place, 1]
                c, d = slit_shares[place, 2], slit_shares[place, 3]
                for i in range(np.uintp(SPLINE_SAMPLES)):
                    line, instant = image[top + i], light * row_shares[place, i]
                    # read before any is written: for all that the compiler knows they overlap
                    e, f = line[left] + instant * a, line[left + ONE] + instant * b
                    g, h = line[left + TWO] + instant * c, line[left + THREE] + instant * d
                    line[left], line[left + ONE], line[left + TWO], line[left + THREE] = e, f, g, h


@fast_loop
def gather_light(images, shares, point, row, row_shares, column, slit_shares, lights):
    """The adjoint of `add_light`: what places find in images of all rows and columns is added up for the
    `point` (places,) of each. A loop over points, each with its places, takes half as long again.
    """
    for number in range(images.shape[0]):
        image, own = images[number], lights[number]
        for place in range(point.size):
            top, left = np.uintp(row[place]), np.uintp(column[place])
            a, b = slit_shares[place, 0], slit_shares[place, 1]
            c, d = slit_shares[place, 2], slit_shares[place, 3]
            total = np.float32(0)
            for i in range(np.uintp(SPLINE_SAMPLES)):
                line = image[top + i]
                instant = a * line[left] + b * line[left + ONE]
                instant += c * line[left + TWO] + d * line[left + THREE]
                total += row_shares[place, i] * instant
            own[point[place]] += shares[point[place]] * total


@fast_loop
def smooth_rows(images, kernel, lags, rows, below, aside, results):
    """Add to some rows of results, (n, rows, columns), the rows of images that lie `lags` before each,
    weighted by a kernel. Row and column 0 of the results are `below` and `aside` of the images; what
    lies outside these counts as dark. Lags increase or decrease.
    """
    taps, height = kernel.size, images.shape[1]
    left, right = max(-aside, 0), min(results.shape[2], images.shape[2] - aside)
    for number in range(images.shape[0]):
        image = images[number]
        for target in rows:
            source = target + below
            line = results[number, target, left:right]
            tap, end = 0, taps
            while tap < end and not (kernel[tap] != 0 and 0 <= source - lags[tap] < height):
                tap += 1
            while end > tap and not (kernel[end - 1] != 0 and 0 <= source - lags[end - 1] < height):
                end -= 1
            # Four rows at a time, as whole lines: the sums stay in registers, and an index into two
            # dimensions would be checked for every pixel. Beyond the end rows count nothing.
            while tap < end:
                second, third, last = (
                    min(tap + 1, end - 1),
                    min(tap + 2, end - 1),
                    min(tap + 3, end - 1),
                )
                a = kernel[tap]
                b = kernel[second] if second > tap else np.float32(0)
                c = kernel[third] if third > second else np.float32(0)
                d = kernel[last] if last > third else np.float32(0)
                line_a = image[source - lags[tap], left + aside :]
                line_b = image[source - lags[second], left + aside :]
                line_c = image[source - lags[third], left + aside :]
                line_d = image[source - lags[last], left + aside :]
                for i in range(line.size):
                    line[i] += a * line_a[i] + b * line_b[i] + c * line_c[i] + d * line_d[i]
                tap += 4


@fast_loop
def smooth_columns(images, kernel, results):
    """Smooth each row of images, (n, rows, columns), with a kernel that is even, of as many taps to either side;
    beyond the images it is dark.
    """
    reach, columns = kernel.size // 2, images.shape[2]
    for number in range(images.shape[0]):
        for row in range(images.shape[1]):
            line, result = images[number, row], results[number, row]
            for i in range(columns):
                result[i] = kernel[reach] * line[i]
            for away in range(1, min(reach + 1, columns)):
                share = kernel[reach + away]
                before, behind = line[: columns - away], line[away:]
                left, right = result[: columns - away], result[away:]
                for i in range(before.size):
                    left[i] += share * behind[i]
                for i in range(before.size):
                    right[i] += share * before[i]


@fast_loop
def add_up_even(values, level, lit, reach, totals):
    """Add up the values of pixels in the square about each that is lit whose level is the same or next."""
    rows, columns = values.shape
    for y in range(rows):
        for x in range(columns):
            if not lit[y, x]:
                continue
            own, total = level[y, x], np.float32(0)
            left, right = max(x - reach, 0), min(x + reach + 1, columns)
            for i in range(max(y - reach, 0), min(y + reach + 1, rows)):
                line, beside = values[i, left:right], level[i, left:right]
                for j in range(line.size):
                    total += line[j] if abs(beside[j] - own) <= 1 else np.float32(0)
            totals[y, x] = total


def prox_masked_tv(
    picture: Image,
    mask: NDArray[np.bool_],
    weight: float,
    iterations: int,
    dual: Image,
    result: Image,
) -> None:
    """Nonnegative proximal step of total variation on a part of a picture; 0 outside the mask.

    Fast gradient projection on the dual (A. Beck and M. Teboulle, IEEE Trans. Image Process. 18,
    2419, 2009), (2, rows, columns), from which the next step starts; neighbours of which one lies
    outside the mask do not count.
    """
    ahead, age, weight = dual.copy(), 1.0, float(weight)
    apply_dual(picture, mask, weight, ahead, result)
    for _ in range(iterations):
        older = (1 + math.sqrt(1 + 4 * age * age)) / 2
        ascend_dual(result, mask, weight, (age - 1) / older, ahead, dual)
        age = older
        apply_dual(picture, mask, weight, ahead, result)


@fast_loop
def apply_dual(picture, mask, weight, ahead, result):
    """The picture that belongs to a dual variable: ``max(picture + weight * div ahead, 0)``."""
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            result[y, x] = 0
            if mask[y, x]:
                divergence = ahead[0, y, x] + ahead[1, y, x]
                if y > 0:
                    divergence -= ahead[0, y - 1, x]
                if x > 0:
                    divergence -= ahead[1, y, x - 1]
                value = picture[y, x] + weight * divergence
                result[y, x] = value if value > 0 else 0.0


@fast_loop
def ascend_dual(result, mask, weight, momentum, ahead, dual):
    """A projected gradient step on the dual variable, with momentum."""
    rows, columns = result.shape
    for y in range(rows):
        for x in range(columns):
            if not mask[y, x]:
                continue
            down, right = 0.0, 0.0
            if y + 1 < rows and mask[y + 1, x]:
                down = result[y + 1, x] - result[y, x]
            if x + 1 < columns and mask[y, x + 1]:
                right = result[y, x + 1] - result[y, x]
            # 8 bounds the squared norm of the gradient of a picture
            p = ahead[0, y, x] + down / (8 * weight)
            q = ahead[1, y, x] + right / (8 * weight)
            length = math.sqrt(p * p + q * q)
            if length > 1:
                p /= length
                q /= length
            ahead[0, y, x] = p + momentum * (p - dual[0, y, x])
            ahead[1, y, x] = q + momentum * (q - dual[1, y, x])
            dual[0, y, x] = p
            dual[1, y, x] = q
