"""Learning a dictionary of light-field patches and recovering from one coded exposure with it."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from apps.studies.light_field_dictionary import (
    LightFieldDictionary,
    learn_dictionary,
    recover_with_dictionary,
)
from tofclip.errors import InputError, MissingDependencyError, ShapeError
from tofclip.light_field import LightField
from tofclip.metrics import nmse
from tofclip.operators import LinearShear
from tofclip.operators.cameras import MarwahCamera

VIEWS = [(float(v), float(u)) for v in range(-1, 2) for u in range(-1, 2)]
SHAPE = (40, 44)


def scene(seed: int) -> LightField:
    """Bright edges at one depth, smooth enough for the shear's interpolation."""
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(np.random.default_rng(seed).standard_normal(SHAPE), 4)
    picture = gaussian_filter((noise > 0).astype(np.float32), 0.7)
    pictures = np.stack([LinearShear(SHAPE, 0.8, view)(picture) for view in VIEWS])
    return LightField(pictures, np.array(VIEWS))


def test_a_light_field_comes_back_from_one_exposure(monkeypatch):
    pytest.importorskip("sklearn")
    monkeypatch.setattr(
        "apps.studies.light_field_dictionary.TRAINING_PATCHES", 500
    )  # a quarter of the time
    dictionary = learn_dictionary([scene(1), scene(2)], patch_px=6, atoms=48, seed=0)
    assert dictionary.atoms.shape == (48, 9, 6, 6)
    assert dictionary.patch_px == 6
    np.testing.assert_allclose(
        np.linalg.norm(dictionary.atoms.reshape(48, -1), axis=1), 1, rtol=1e-5
    )
    true, camera = scene(3), MarwahCamera(SHAPE, VIEWS, 1, 0)
    exposure = camera.light_field_model()(true.pictures).reshape(SHAPE)
    found = recover_with_dictionary(exposure, camera.codes(), dictionary)
    # A control: the exposure itself, as bright as a view, for every view.
    plain = np.broadcast_to(exposure / camera.codes().sum(axis=0), true.pictures.shape)
    error = nmse(found, true.pictures, 6)
    assert error < 0.05
    assert error < 0.3 * nmse(plain, true.pictures, 6)


def test_a_patch_made_of_few_atoms_is_found():
    """Two of twenty random atoms and brightness: the exposure's 64 pixels tell which, the weight
    takes its toll.
    """
    random = np.random.default_rng(0)
    atoms = random.standard_normal((20, 9, 8, 8)).astype(np.float32)
    atoms[0] = 1
    atoms /= np.linalg.norm(atoms.reshape(20, -1), axis=1)[:, None, None, None]
    true = 30 * atoms[0] + 5 * atoms[7] - 4 * atoms[12]
    codes = MarwahCamera((8, 8), VIEWS, 1, 1).codes()
    found = recover_with_dictionary(
        (codes * true).sum(axis=0), codes, LightFieldDictionary(atoms), 1e-4, 2000
    )
    np.testing.assert_allclose(found, true, atol=0.02 * np.abs(true).max())


def test_what_does_not_fit_is_refused():
    dictionary = LightFieldDictionary(np.ones((2, 9, 6, 6), np.float32))
    with pytest.raises(ShapeError, match="mask codes"):
        recover_with_dictionary(np.ones((8, 8)), np.ones((4, 8, 8)), dictionary)
    with pytest.raises(ShapeError, match="a patch"):
        recover_with_dictionary(np.ones((5, 8)), np.ones((9, 5, 8)), dictionary)


def test_light_fields_that_teach_nothing_are_refused():
    pytest.importorskip("sklearn")
    with pytest.raises(InputError, match="at least one light field"):
        learn_dictionary([])
    with pytest.raises(ShapeError, match="to learn from"):
        learn_dictionary([scene(1)], patch_px=41)


def test_without_scikit_learn_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.decomposition", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[learning\]"):
        learn_dictionary([scene(1)])
