"""`RandomForest`: scikit-learn's forest to fit, flat arrays to predict, and the thesis's regularisation under DaD.

As DaD's aggregate D grows from D_0, a forest would overfit the growing cloud of corrections. With the learning rate
eta = 1/(1 + n)^0.5 of iteration n the least number of samples in a leaf grows as

    max(1, eta |D| / |D_0|)                                                  (Sec. 3.1.3)

times `min_samples_leaf`; depth and number of trees are limited too.

Reference: thesis proposal, Sec. 3.1.3; Breiman, "Random forests", 2001.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.ensemble import RandomForestRegressor
from sklearn.utils.validation import check_is_fitted, validate_data

Array = NDArray[np.float64]
BLOCK = 2**20  # trees x rows that go down the trees at once


class RandomForest(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """A random forest whose predictions cost microseconds a row, in batches or one by one.

    Args:
        n_estimators: trees. max_depth: of a tree; None for no limit.
        min_samples_leaf: least samples of a leaf, before DaD's scaling.
        max_features: share or number of inputs tried at each split.
        max_samples: share or number of samples drawn for each tree; None for as many as there are. A number bounds
            the cost of a tree while DaD's aggregate grows.
        leaf_growth: whether `for_aggregate` scales `min_samples_leaf`.
        random_state: of the trees. n_jobs: threads that grow them.

    Attributes:
        n_features_in_: inputs. min_samples_leaf_: as used.
    """

    def __init__(
        self,
        *,
        n_estimators: int = 50,
        max_depth: int | None = 15,
        min_samples_leaf: int = 1,
        max_features: float | int | str = 1.0,
        max_samples: float | int | None = None,
        leaf_growth: bool = True,
        random_state: int | np.random.RandomState | None = None,
        n_jobs: int | None = None,
    ) -> None:
        self.n_estimators = n_estimators
        self.max_depth = max_depth
        self.min_samples_leaf = min_samples_leaf
        self.max_features = max_features
        self.max_samples = max_samples
        self.leaf_growth = leaf_growth
        self.random_state = random_state
        self.n_jobs = n_jobs

    def for_aggregate(self, iteration: int, growth: float) -> Self:
        """The regressor to fit to DaD's aggregate: `min_samples_leaf` scaled by max(1, eta growth).

        Args:
            iteration: n, 0 for the data themselves. growth: |D| / |D_0|.
        """
        one = self.__class__(**self.get_params(deep=False))
        if self.leaf_growth:
            eta = (1.0 + iteration) ** -0.5
            one.min_samples_leaf = max(1, round(self.min_samples_leaf * max(1.0, eta * growth)))
        return one

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Grow the trees.

        Args:
            X: (n, n_inputs). y: (n, d) or (n,).
        """
        inputs: Any
        targets: Any
        inputs, targets = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        self._y_ndim = targets.ndim
        samples = self.max_samples
        if isinstance(samples, int | np.integer) and not isinstance(samples, bool):
            samples = min(int(samples), len(inputs))  # a number above n would be refused
        forest = RandomForestRegressor(
            self.n_estimators,
            max_depth=self.max_depth,
            min_samples_leaf=self.min_samples_leaf,
            max_features=self.max_features,
            max_samples=samples,
            random_state=self.random_state,
            n_jobs=self.n_jobs,
        )
        n_targets = 1 if targets.ndim == 1 else targets.shape[1]
        forest.fit(inputs, targets.reshape(-1) if n_targets == 1 else targets)
        self.min_samples_leaf_ = self.min_samples_leaf
        self._flatten(forest, n_targets)
        return self

    def predict(self, X: ArrayLike) -> Array:
        """(n, n_inputs) -> (n, d), or (n,) where y was 1-D: the mean over the trees."""
        check_is_fitted(self)
        inputs: Any = validate_data(self, X, dtype=np.float64, reset=False)
        predicted = self.predict_unchecked(inputs)
        return predicted[:, 0] if self._y_ndim == 1 else predicted

    def predict_unchecked(self, X: Array) -> Array:
        """(n, n_inputs) -> (n, d), without checks: the inner loop of rollouts."""
        rows = max(1, BLOCK // len(self._roots))
        blocks = [self._descend(X[i : i + rows]) for i in range(0, len(X), rows)]
        return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)

    def _descend(self, X: Array) -> Array:
        """Every row down every tree at once, one level a pass; pairs that have reached a leaf drop out."""
        n, n_trees = len(X), len(self._roots)
        inputs = np.ascontiguousarray(X, dtype=np.float32)  # scikit-learn compares in float32
        flat, width = inputs.reshape(-1), inputs.shape[1]
        leaf = np.repeat(self._roots, n)
        going = np.flatnonzero(self._left[leaf] >= 0)
        node, start = leaf[going], (going % n) * width
        while len(going):
            left = flat[start + self._input[node]] <= self._threshold[node]
            node = np.where(left, self._left[node], self._right[node])
            inside = self._left[node] >= 0
            leaf[going[~inside]] = node[~inside]
            going, node, start = going[inside], node[inside], start[inside]
        return self._value[leaf].reshape(n_trees, n, -1).sum(axis=0) / n_trees

    def _flatten(self, forest: RandomForestRegressor, n_targets: int) -> None:
        """The nodes of all trees one after the other; a leaf's children are -1."""
        trees = [tree.tree_ for tree in forest.estimators_]
        self._roots = np.cumsum([0, *(tree.node_count for tree in trees[:-1])])
        self._left = _shifted([tree.children_left for tree in trees], self._roots)
        self._right = _shifted([tree.children_right for tree in trees], self._roots)
        self._input = np.concatenate([tree.feature for tree in trees])
        self._threshold = np.concatenate([tree.threshold for tree in trees])
        self._value = np.concatenate([tree.value.reshape(tree.node_count, n_targets) for tree in trees])


def _shifted(children: list[NDArray[np.int64]], roots: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([np.where(c < 0, -1, c + root) for c, root in zip(children, roots, strict=True)])
