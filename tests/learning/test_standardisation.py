"""Bringing components to one scale."""

import numpy as np

from beliefgym.learning.standardisation import Standardisation


def test_standardisation_brings_rows_to_mean_zero_and_deviation_one():
    rows = np.random.default_rng(1).normal(size=(60, 2)) * [3.0, 0.1] + [1.0, -2.0]
    standard = Standardisation.of(rows)
    z = standard.apply(rows)
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=1e-14)  # 78 roundings of numbers of a few units
    np.testing.assert_allclose(z.std(axis=0), 1.0, rtol=1e-14)
    np.testing.assert_allclose(standard.invert(z), rows, rtol=0, atol=1e-13)  # numbers of about 100
    assert not standard.constant.any()
    assert Standardisation.of(np.full((7, 1), 0.1)).constant.all()  # although the mean is rounded
    np.testing.assert_array_equal(Standardisation.none(np.zeros((1, 2))).apply(rows), rows)


def test_together_all_components_take_one_scale():
    """The root mean square of the standard deviations; a component that does not vary adds nothing."""
    rows = np.random.default_rng(0).normal(size=(500, 3)) * [1.0, 7.0, 0.0] + [5.0, -3.0, 2.0]
    together = Standardisation.together(rows)
    np.testing.assert_allclose(together.scale, np.sqrt(rows.var(axis=0).mean()), rtol=1e-12)
    np.testing.assert_allclose(together.offset, rows.mean(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(together.constant, [False, False, True])
    assert Standardisation.together(np.ones((4, 2))).scale.tolist() == [1.0, 1.0]
