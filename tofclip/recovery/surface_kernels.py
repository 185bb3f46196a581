"""The compiled products of the surface model: amplitudes to a raw streak image, and back.

Light of one surface point falls, in each view, on a few columns and on the rows of its pulse; its
fraction of a measurement is the product of a share along the slit and one along time. Both are kept
for each point and view, (points, views, ...), so that neither the matrix nor its transpose is
stored.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

nogil_njit = njit(nogil=True, cache=True, fastmath=True, error_model="numpy")


@nogil_njit
def split_over_time(row, sigma, first, shares, slopes):
    """Share of a Gaussian pulse that falls on each row, and its derivative by the pulse's position.

    Parameters
    ----------
    row, sigma : (points, views) float64 array
        Middle and standard deviation of the pulse, raw rows; row i reaches from i - 1/2 to i + 1/2.
    first : (points, views) int32 array, overwritten
        First row of each pulse.
    shares, slopes : (points, views, reach) float32 array, overwritten
    """
    reach = shares.shape[2]
    for point in range(row.shape[0]):
        for view in range(row.shape[1]):
            middle, width = row[point, view], sigma[point, view]
            start = int(np.round(middle)) - reach // 2
            first[point, view] = start
            below, density = 0.0, 0.0
            for edge in range(reach + 1):
                z = (start + edge - 0.5 - middle) / width
                # the Gaussian's integral up to the edge; its difference over a bin is the bin's
                # fraction
                upto = 0.5 * (1.0 + math.erf(z * 0.7071067811865476))
                here = math.exp(-0.5 * z * z) * 0.3989422804014327 / width
                if edge > 0:
                    shares[point, view, edge - 1] = upto - below
                    # derivative of that fraction with the arrival time
                    slopes[point, view, edge - 1] = density - here
                below = upto
                density = here


@nogil_njit
def split_over_slit(position, tangent, subrows, first, shares):
    """Share of a picture pixel that falls on each slit pixel.

    A pixel is a square of side 1: its width and the slit pixel's make a triangle, and its height
    spreads it by the tangent of the line's angle, for which `subrows` lines stand.

    Parameters
    ----------
    position : (points, views) float64 array
        Slit position of the pixel's middle.
    tangent : (views,) float64 array
        Of the views' line angles.
    subrows : int
    first : (points, views) int32 array, overwritten
    shares : (points, views, reach) float32 array, overwritten
    """
    reach = shares.shape[2]
    for point in range(position.shape[0]):
        for view in range(position.shape[1]):
            # a row of the picture is projected to tan(angle) slit pixels
            spread = abs(tangent[view])
            start = int(np.floor(position[point, view] - 0.5 * spread))
            first[point, view] = start
            shares[point, view, :] = 0
            for line in range(subrows):
                place = position[point, view] + ((line + 0.5) / subrows - 0.5) * spread
                column = int(np.floor(place))
                weight = place - column
                if column - start < reach:
                    shares[point, view, column - start] += (1 - weight) / subrows
                if column + 1 - start < reach:
                    shares[point, view, column + 1 - start] += weight / subrows


@nogil_njit
def add_light(amplitude, gains, first_row, time_shares, first_column, slit_shares, image):
    """Add the light of surface points to a raw streak image.

    Parameters
    ----------
    amplitude : (points,) float32 array
    gains : (views,) float64 array
    first_row, first_column : (points, views) int32 array
    time_shares, slit_shares : (points, views, reach) float32 array
    image : (rows, columns) float32 array, added to
    """
    rows, columns = image.shape
    for point in range(amplitude.size):
        # most points of a volume are dark
        if amplitude[point] == 0:
            continue
        for view in range(gains.size):
            light = np.float32(amplitude[point] * gains[view])
            for i in range(time_shares.shape[2]):
                row = first_row[point, view] + i
                if row < 0 or row >= rows:
                    continue
                instant = light * time_shares[point, view, i]
                for j in range(slit_shares.shape[2]):
                    column = first_column[point, view] + j
                    if 0 <= column < columns:
                        image[row, column] += instant * slit_shares[point, view, j]


@nogil_njit
def gather_light(image, gains, first_row, time_shares, first_column, slit_shares, amplitude):
    """The adjoint of `add_light`: what each point's light would find in an image.

    Parameters
    ----------
    image : (rows, columns) float32 array
    gains : (views,) float64 array
    first_row, first_column : (points, views) int32 array
    time_shares, slit_shares : (points, views, reach) float32 array
    amplitude : (points,) float32 array, overwritten
    """
    rows, columns = image.shape
    for point in range(amplitude.size):
        total = 0.0
        for view in range(gains.size):
            found = np.float32(0)
            for i in range(time_shares.shape[2]):
                row = first_row[point, view] + i
                if row < 0 or row >= rows:
                    continue
                instant = np.float32(0)
                for j in range(slit_shares.shape[2]):
                    column = first_column[point, view] + j
                    if 0 <= column < columns:
                        instant += slit_shares[point, view, j] * image[row, column]
                found += time_shares[point, view, i] * instant
            total += gains[view] * found
        amplitude[point] = total


@nogil_njit
def prox_masked_tv(picture, mask, weight, iterations, dual, result):
    """Nonnegative proximal step of total variation on a part of a picture.

    Fast gradient projection on the dual (A. Beck and M. Teboulle, IEEE Trans. Image Process. 18,
    2419, 2009); neighbours of which one lies outside the mask do not count.

    Parameters
    ----------
    picture : (rows, columns) float32 array
    mask : (rows, columns) bool array
    weight : float
    iterations : int
    dual : (2, rows, columns) float32 array, overwritten
        Start, and what to start from the next time.
    result : (rows, columns) float32 array, overwritten
        0 outside the mask.
    """
    ahead = dual.copy()
    age = 1.0
    apply_dual(picture, mask, weight, ahead, result)
    for _ in range(iterations):
        older = (1 + math.sqrt(1 + 4 * age * age)) / 2
        ascend_dual(result, mask, weight, (age - 1) / older, ahead, dual)
        age = older
        apply_dual(picture, mask, weight, ahead, result)


@nogil_njit
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
                result[y, x] = max(picture[y, x] + weight * divergence, 0.0)


@nogil_njit
def ascend_dual(result, mask, weight, momentum, ahead, dual):
    """A projected gradient step on the dual variable, with momentum."""
    rows, columns = result.shape
    for y in range(rows):
        for x in range(columns):
            down, right = 0.0, 0.0
            if mask[y, x] and y + 1 < rows and mask[y + 1, x]:
                down = result[y + 1, x] - result[y, x]
            if mask[y, x] and x + 1 < columns and mask[y, x + 1]:
                right = result[y, x + 1] - result[y, x]
            # 8 bounds the squared norm of the gradient of a picture
            p = ahead[0, y, x] + down / (8 * weight)
            q = ahead[1, y, x] + right / (8 * weight)
            length = max(1.0, math.sqrt(p * p + q * q))
            p /= length
            q /= length
            ahead[0, y, x] = p + momentum * (p - dual[0, y, x])
            ahead[1, y, x] = q + momentum * (q - dual[1, y, x])
            dual[0, y, x] = p
            dual[1, y, x] = q
