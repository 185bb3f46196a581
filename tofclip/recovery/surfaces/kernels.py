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

from tofclip.compiling import compile_loop

Image = NDArray[np.float32]

fast_loop = compile_loop(fastmath=True)

SPLINE_SAMPLES = 3
LEAST_SPREAD = 1e-3  # px, of a view whose lines are upright


def split_between_rows(row: NDArray[np.float64]) -> tuple[NDArray[np.int32], Image]:
    """Put positions, (points,), between rows: the first of three, and samples of the quadratic
    B-spline there, (points, 3).
    """
    middle = np.floor(row + 0.5)
    off = row - middle
    shares = np.empty((row.size, SPLINE_SAMPLES), np.float32)
    shares[:, 0] = 0.5 * (0.5 - off) ** 2
    shares[:, 1] = 0.75 - off * off
    shares[:, 2] = 0.5 * (0.5 + off) ** 2
    return middle.astype(np.int32) - np.int32(1), shares


@fast_loop
def split_over_slit(position, width, height, tangent, first, shares):
    """Share of parts of picture pixels that falls on each slit pixel, (parts, reach), from `first` on.
    A part is a rectangle, px: its height spreads it by the tangent of the line's angle, so that its
    light on the slit is a trapezium, whose integral is made of four parabolas.
    """
    reach = shares.shape[1]
    for part in range(position.size):
        across, spread = width[part], max(math.fabs(tangent) * height[part], LEAST_SPREAD)
        wide, narrow = 0.5 * (across + spread), 0.5 * math.fabs(across - spread)
        start = math.floor(position[part] - wide + 0.5)
        first[part] = start
        before = 0.0
        for slit in range(reach):
            edge = start + slit + 0.5 - position[part]
            upto = max(edge + wide, 0.0) ** 2 - max(edge + narrow, 0.0) ** 2
            upto += max(edge - wide, 0.0) ** 2 - max(edge - narrow, 0.0) ** 2
            upto /= 2 * across * spread
            shares[part, slit] = upto - before
            before = upto


@fast_loop
def add_light(light, starts, row, row_shares, column, slit_shares, above, before, image):
    """Add the light of surface points, so much from each of a point's places, to the image of a view; all
    of it must fall inside. `starts` (points + 1,): first place of each; `row, column` (places,): first of
    those that a place reaches, shares there (places, 3) and (places, 4); `above, before`: the image's
    first ones.
    """
    for point in range(light.size):
        # most points of a volume are dark
        if light[point] == 0:
            continue
        for place in range(starts[point], starts[point + 1]):
            top, left = row[place] - above, column[place] - before
            for i in range(3):
                instant = light[point] * row_shares[place, i]
                for j in range(4):
                    image[top + i, left + j] += instant * slit_shares[place, j]


@fast_loop
def gather_light(image, gain, point, row, row_shares, column, slit_shares, above, amplitude):
    """The adjoint of `add_light`, but for the points' shares: what places would find in an image of all
    columns is added up for the `point` (places,) of each. A loop over points, each with its places,
    takes half as long again.
    """
    for place in range(point.size):
        top, left = row[place] - above, column[place]
        total = 0.0
        for i in range(3):
            instant = 0.0
            for j in range(4):
                instant += slit_shares[place, j] * image[top + i, left + j]
            total += row_shares[place, i] * instant
        amplitude[point[place]] += gain * total


@fast_loop
def smooth_rows(image, kernel, lags, rows, margin, result):
    """Add up the rows of an image that lie `lags` before each row, weighted by a kernel, for some of the
    result's rows, of which row 0 is row `margin` of the image; what lies outside the image counts as
    dark. Lags increase or decrease.
    """
    taps, height = kernel.size, image.shape[0]
    for number in range(rows.size):
        target = rows[number]
        line, source = result[target], target + margin
        for i in range(line.size):
            line[i] = 0
        tap, end = 0, taps
        while tap < end and not (kernel[tap] != 0 and 0 <= source - lags[tap] < height):
            tap += 1
        while end > tap and not (kernel[end - 1] != 0 and 0 <= source - lags[end - 1] < height):
            end -= 1
        # Four rows at a time, as whole lines: the sums stay in registers, and an index into two
        # dimensions would be checked for every pixel.
        while tap + 4 <= end:
            a, b, c, d = kernel[tap], kernel[tap + 1], kernel[tap + 2], kernel[tap + 3]
            line_a, line_b = image[source - lags[tap]], image[source - lags[tap + 1]]
            line_c, line_d = image[source - lags[tap + 2]], image[source - lags[tap + 3]]
            for i in range(line.size):
                line[i] += a * line_a[i] + b * line_b[i] + c * line_c[i] + d * line_d[i]
            tap += 4
        while tap < end:
            weight, other = kernel[tap], image[source - lags[tap]]
            for i in range(line.size):
                line[i] += weight * other[i]
            tap += 1


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
