"""Light fields from one coded exposure with a learnt dictionary.

The method of K. Marwah et al., ACM Trans. Graph. 32, 46 (2013), to compare CLIP with (supplement
Note 5 and 8): patches of a light field are sparse in a dictionary that was learnt from others, and
a patch of the exposure is enough to find which atoms they are made of.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, MissingDependencyError, ShapeError
from tofclip.light_field import LightField
from tofclip.threads import split_blocks

Array = NDArray[Any]

PATCHES_PER_BATCH = 64
TRAINING_PATCHES = 2000
# principal components that patches are learnt in: light fields have few, and learning is as much
# faster
MAX_COMPONENTS = 256
SPARSITY_WEIGHT = 0.2  # of unit patches
EPOCHS = 2


@dataclass(frozen=True)
class LightFieldDictionary:
    """Atoms that patches of light fields are made of."""

    # (atoms, views, rows, columns), of unit norm. The first is constant: brightness costs nothing
    # in a recovery
    atoms: Array

    @property
    def patch_px(self) -> int:
        """Rows and columns of a patch."""
        return int(self.atoms.shape[2])


def learn_dictionary(
    light_fields: Sequence[LightField], patch_px: int = 8, atoms: int = 256, seed: int = 0
) -> LightFieldDictionary:
    """Learn atoms from patches of light fields with the same views (scikit-learn's online
    dictionary learning); a patch has `patch_px` rows and columns, and all views.
    """
    try:
        from sklearn.decomposition import PCA, MiniBatchDictionaryLearning
        from sklearn.exceptions import ConvergenceWarning
    except ImportError as fault:
        raise MissingDependencyError(
            "learning a dictionary needs scikit-learn: pip install 'tofclip[learning]'"
        ) from fault
    patches = _draw_training_patches(light_fields, patch_px, np.random.default_rng(seed))
    flat = patches.reshape(len(patches), -1)
    kept = min(MAX_COMPONENTS, *flat.shape)
    components = PCA(kept, svd_solver="randomized", random_state=seed).fit(flat).components_
    learner = MiniBatchDictionaryLearning(
        # One atom is kept for brightness: patches are learnt without their mean.
        atoms - 1,
        alpha=SPARSITY_WEIGHT,
        max_iter=EPOCHS,
        batch_size=64,
        fit_algorithm="cd",
        random_state=seed,
    )
    with warnings.catch_warnings():
        # Shares that are not exact in one step are mended by the next batches.
        warnings.simplefilter("ignore", ConvergenceWarning)
        found = learner.fit(flat @ components.T).components_ @ components
    every = np.concatenate([np.ones((1, flat.shape[1])), found]).astype(np.float32)
    every /= np.linalg.norm(every, axis=1, keepdims=True)
    return LightFieldDictionary(every.reshape(-1, *patches.shape[1:]))


def recover_with_dictionary(
    exposure: Array,
    codes: Array,
    dictionary: LightFieldDictionary,
    weight: float = 1e-2,
    iterations: int = 100,
) -> Array:
    """Recover a light field from one coded exposure, patch by patch, overlapping by half; their
    mean is taken.

    For each patch ``1/2 |y - sum_k C_k (D a)_k|^2 + w |a|_1`` is minimised by FISTA; the constant
    atom is free.

    `exposure` (rows, columns); `codes` (views, rows, columns): the mask as each view sees it,
    `MarwahCamera.codes`; `weight`: sparsity, relative to each patch's largest correlation with an
    atom. Returns (views, rows, columns).

    Memory beyond the result is that of 64 patches' coded dictionaries, 4 MB with the default sizes.
    """
    expected = (dictionary.atoms.shape[1], *exposure.shape)
    if codes.shape != expected:
        raise ShapeError("mask codes for this dictionary and exposure", expected, codes.shape)
    size = dictionary.patch_px
    if min(exposure.shape) < size:
        raise ShapeError("the exposure", f"at least ({size}, {size}) px, a patch", exposure.shape)
    total, count = np.zeros(codes.shape, np.float32), np.zeros(exposure.shape, np.float32)
    # Upper left corners of patches that cover everything, the last ones flush with the border.
    stride = max(size // 2, 1)
    corners = [
        *product(
            *(sorted({*range(0, side - size + 1, stride), side - size}) for side in exposure.shape)
        )
    ]
    for some in split_blocks(len(corners), PATCHES_PER_BATCH):
        windows = [(slice(y, y + size), slice(x, x + size)) for y, x in corners[some]]
        measurements = np.stack([exposure[window].ravel() for window in windows]).astype(np.float32)
        masks = np.stack([codes[(slice(None), *window)] for window in windows]).astype(np.float32)
        coded = masks.transpose(2, 3, 0, 1) @ dictionary.atoms.transpose(2, 3, 1, 0)
        by_patch = np.ascontiguousarray(coded.reshape(size * size, len(windows), -1).swapaxes(0, 1))
        shares = _compute_sparse_weights(by_patch, measurements, weight, iterations)
        patches = np.tensordot(shares, dictionary.atoms, axes=1)
        for window, patch in zip(windows, patches, strict=True):
            total[(slice(None), *window)] += patch
            count[window] += 1
    # Every pixel lies in at least one patch.
    return total / count


def _compute_sparse_weights(
    coded: Array, measurements: Array, weight: float, iterations: int
) -> Array:
    """Shares of the atoms, (patches, atoms), for coded dictionaries (patches, pixels, atoms)."""
    transposed = coded.swapaxes(1, 2)
    correlation = (transposed @ measurements[..., np.newaxis])[..., 0]
    largest = np.linalg.eigvalsh(coded @ transposed)[:, -1:]  # of each dictionary's Gram matrix
    step = 1 / np.maximum(1.05 * largest, np.finfo(np.float32).tiny)
    threshold = step * weight * np.abs(correlation).max(axis=1, keepdims=True)
    threshold = np.repeat(threshold, correlation.shape[1], axis=1)
    threshold[:, 0] = 0  # brightness
    shares = ahead = np.zeros_like(correlation)
    age = 1.0
    for _ in range(iterations):
        residual = coded @ ahead[..., np.newaxis] - measurements[..., np.newaxis]
        moved = ahead - step * (transposed @ residual)[..., 0]
        following = np.sign(moved) * np.maximum(np.abs(moved) - threshold, 0)
        # FISTA (A. Beck and M. Teboulle, SIAM J. Imaging Sci. 2, 183 (2009)).
        older, age = age, (1 + np.sqrt(1 + 4 * age**2)) / 2
        ahead = following + np.float32((older - 1) / age) * (following - shares)
        shares = following
    return shares


def _draw_training_patches(
    light_fields: Sequence[LightField], patch_px: int, random: np.random.Generator
) -> Array:
    """Patches at random places, those with most contrast, their mean taken off and their norm made
    1.
    """
    if not light_fields:
        raise InputError("at least one light field is needed to learn from")
    views, size, found = len(light_fields[0].pictures), (patch_px, patch_px), list[Array]()
    for light_field in light_fields:
        pictures = light_field.pictures
        if len(pictures) != views or min(pictures.shape[1:]) < patch_px:
            expected = f"({views}, at least {patch_px}, at least {patch_px})"
            raise ShapeError("every light field to learn from", expected, pictures.shape)
        windows = np.lib.stride_tricks.sliding_window_view(pictures, size, (1, 2))
        _, rows, columns, *_ = windows.shape
        chosen = random.permutation(rows * columns)[: 4 * TRAINING_PATCHES // len(light_fields)]
        found.append(windows[:, chosen // columns, chosen % columns].swapaxes(0, 1))
    patches = np.concatenate(found)
    spread = patches.std(axis=(1, 2, 3))
    kept = np.argsort(spread)[::-1][:TRAINING_PATCHES]
    kept = kept[spread[kept] > 0]
    if kept.size == 0:
        raise InputError(
            "the light fields are flat everywhere; there is nothing to learn from them"
        )
    patches = patches[kept] - patches[kept].mean(axis=(1, 2, 3), keepdims=True)
    norms = spread[kept, np.newaxis, np.newaxis, np.newaxis] * np.sqrt(patches[0].size)
    unit: Array = patches / norms
    return unit
