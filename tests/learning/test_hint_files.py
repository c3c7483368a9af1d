"""Saved filters of hints: what comes back filters and estimates as what was saved."""

from pathlib import Path

import numpy as np
import pytest

from beliefgym.learning import (
    HintEstimator,
    InferenceMachineFilter,
    LinearGaussianSystem,
    PSIMHints,
    RandomForest,
    RandomFourierRidge,
    Ridge,
    Sequences,
    load_filter,
    save_filter,
)


@pytest.fixture(scope="module")
def data() -> tuple[Sequences, Sequences]:
    """Two observations of three states, the states as hints."""
    transition = np.array([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 0.7]])
    observation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    system = LinearGaussianSystem(transition, observation, 0.1 * np.eye(3), 0.2 * np.eye(2))
    rng = np.random.default_rng(0)
    train, test = system.sample(40, 30, rng), system.sample(5, 20, rng)
    return train, test


WAVES = RandomFourierRidge(n_frequencies=20, include_inputs=True, random_state=0)
FILTERS = {
    "linear": PSIMHints(Ridge(), n_future=3, hints_from="states", n_iterations=2, preimage=Ridge()),
    "second": PSIMHints(WAVES, n_future=2, features="second", hints_from="states", n_iterations=2),
    "belief": PSIMHints(
        Ridge(), n_hints=2, hint_weight=2.0, hints_from="states", n_iterations=2, preimage="belief"
    ),
    "imf": InferenceMachineFilter(WAVES, features="second", hints_from="states", n_iterations=2),
}


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("with_validation", [False, True])
def test_a_loaded_filter_estimates_as_the_saved_one(
    name: str, with_validation: bool, data: tuple[Sequences, Sequences], tmp_path: Path
) -> None:
    train, test = data
    filter = FILTERS[name].fit(train[:30], train[30:] if with_validation else None)
    path = save_filter(filter, tmp_path / "filter.safetensors")
    loaded = load_filter(path)
    assert type(loaded) is type(filter)
    for ours, theirs in zip(filter.estimate_hints(test), loaded.estimate_hints(test), strict=True):
        np.testing.assert_array_equal(ours, theirs)  # the same arrays, in the same order of memory
    belief = filter.beliefs(test)[:, 7]
    np.testing.assert_array_equal(loaded.forecast(belief, 6), filter.forecast(belief, 6))
    np.testing.assert_array_equal(loaded.gap_growth_, filter.gap_growth_)
    assert loaded.preimage_errors_ == filter.preimage_errors_
    gap = np.array([np.nan, 0.3])
    one, other = (HintEstimator(each, missing="predict").update(gap) for each in (filter, loaded))
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.std, other.std)


def test_a_chosen_preimage_is_the_parameter_of_the_loaded_filter(
    data: tuple[Sequences, Sequences], tmp_path: Path
) -> None:
    given = [Ridge(alpha=1e-3), RandomForest(n_estimators=3, max_depth=2, random_state=0)]
    filter = PSIMHints(Ridge(), n_future=2, hints_from="states", n_iterations=1, preimage=given).fit(data[0])
    loaded = load_filter(filter.save(tmp_path / "filter.safetensors"))
    assert loaded.preimage.get_params() == given[0].get_params()  # linear data: the forest of stumps loses


def test_what_cannot_be_saved_is_told(data: tuple[Sequences, Sequences], tmp_path: Path) -> None:
    forest = PSIMHints(
        Ridge(), n_future=2, hints_from="states", n_iterations=1, preimage=RandomForest(n_estimators=2)
    ).fit(data[0])
    with pytest.raises(
        TypeError, match="expected a filter with Ridge or RandomFourierRidge to save, got one with Ran"
    ):
        save_filter(forest, tmp_path / "filter.safetensors")
    own = PSIMHints(
        Ridge(),
        n_future=2,
        hints_from="states",
        n_iterations=1,
        preimage=Ridge(),
        features=lambda h, f: h[:, 0],
    ).fit(data[0])
    with pytest.raises(TypeError, match="functions of one's own"):
        save_filter(own, tmp_path / "filter.safetensors")
    assert not list(tmp_path.iterdir())
