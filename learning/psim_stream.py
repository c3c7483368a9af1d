"""`LearningStream`: a predictive state inference machine that goes on learning from what it filters.

The filter of time t has the belief m_t and meets x_t. Once x_{t-k+1} .. x_t are known, the target of what it met k
steps ago is complete, and joins the aggregate:

    D <- D + {((m_{t-k}, x_{t-k}), phi(x_{t-k+1}, .., x_t))},      F <- argmin_F  sum_D |F(m, x) - phi(f)|^2

Each m is that of the filter in force then, as in Algorithm 4, of which this is the version that never ends: the loss of
a refit is that of the pairs since the last one, follow the leader (or online gradient descent) is a no-regret
algorithm, and so the mean error falls to that of the best fixed filter on the inputs met (Eq. 3.28). Where the system
drifts, forgetting keeps the filter with the present one.

Cost of an update, for F linear in p features: n p^2 for the sums of n streams, and at a refit p^3 / 3. With 72 inputs
and one stream an update takes 0.4 ms with a refit each time and 0.1 ms without, on one core, and most of that is the
calls, not the arithmetic: 16 streams take 0.42 ms together.

References: thesis proposal, Sec. 3.3.3 (Algorithm 4 and Corollary 4); Ross, Gordon & Bagnell, "A reduction of imitation
learning and structured prediction to no-regret online learning", AISTATS 2011. Learning from a single stream with
targets that come k steps late, and forgetting, are this package's.
"""

from __future__ import annotations

from copy import copy, deepcopy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.learning.aggregation import GradientSteps, Learner, StoredAggregate
from beliefgym.learning.filters import check_finite, check_whole
from beliefgym.learning.psim import PSIM

Array = NDArray[np.float64]


class LearningStream:
    """A fitted `PSIM` on n live streams at once, learning from all of them.

    It starts with the chosen filter; the first refit brings that of its aggregate, which is the aggregate of
    `PSIM.fit` and the pairs met since. Coordinates, features, their read-out, the initial belief and the bounds stay
    those of the fit. As in training, nothing is learned from a belief that had to be kept inside its bounds.

    Args:
        psim: fitted, not from a file; it is left as it is.
        n: streams.
        refit_every: updates between two refits; a large number only collects. A regressor that is not linear in
            features keeps all pairs and is fitted to them anew at each refit.
        forgetting: weight of the aggregate after a refit, in (0, 1]; below 1 the pairs that came j refits before the
            last count forgetting^j. A regressor linear in features and follow the leader are needed for that.

    Raises:
        TypeError: not a PSIM, or a regressor that cannot forget. NotFittedError. ValueError: numbers out of range,
            forgetting with online gradient descent, or a PSIM from a file.

    Example:
        >>> stream = LearningStream(PSIM(n_future=5).fit(train, validation), forgetting=0.999)  # doctest: +SKIP
        >>> belief = stream.update(observation[None])  # doctest: +SKIP
    """

    def __init__(self, psim: PSIM, n: int = 1, refit_every: int = 1, forgetting: float = 1.0) -> None:
        if not isinstance(psim, PSIM):
            raise TypeError(f"expected a fitted PSIM, got {type(psim).__name__}")
        check_whole("n", n, 1)
        check_whole("refit_every", refit_every, 1)
        if not 0 < forgetting <= 1:
            raise ValueError(f"expected forgetting in (0, 1], got {forgetting!r}")
        psim._check_fitted()
        if psim.action_timing != "none":
            raise TypeError(f"expected a PSIM without actions, got a {type(psim).__name__} fitted with them")
        learner = psim._held_learner()
        if forgetting < 1 and isinstance(learner, GradientSteps):
            raise ValueError(
                f"expected forgetting=1 with 'online_gradient', which keeps no aggregate, got {forgetting:g}; its "
                "step_size says how fast it follows"
            )
        if forgetting < 1 and isinstance(learner, StoredAggregate):
            raise TypeError(
                "expected a PSIM linear in features (Ridge, RandomFourierRidge, PolynomialRidge) with forgetting "
                f"{forgetting:g}, got one of {type(psim.regressor).__name__}"
            )
        self.n, self.refit_every, self.forgetting = int(n), int(refit_every), float(forgetting)
        self._psim = copy(psim)
        self._learner: Learner = deepcopy(learner)
        del self._psim._learner
        self._psim._told_divergence = False
        self._belief = self._psim.initial_belief(self.n)
        k = self._psim.n_future
        self._met = np.zeros((self.n, k + 1, self._belief.shape[1] + self._psim.n_obs_))  # a ring, by `_slot`
        self._is_inside = np.ones((self.n, k + 1), dtype=np.bool_)
        self._slot = 0  # of the present belief
        self._n_seen = np.zeros(self.n, dtype=np.int64)
        self._n_updates, self._n_new, self._n_refits = 0, 0, 0
        self._squared_error, self._n_predicted = 0.0, 0

    def update(self, observation: ArrayLike) -> Array:
        """Take in one observation of each stream, learn from those k steps ago, and refit where it is time.

        Args:
            observation: (n, n_obs), in the units of the training data.

        Returns:
            (n, belief_size), of the observations that follow.

        Raises:
            ValueError: shapes, NaN or infinities, and where; the stream is then as it was before.
        """
        psim, k, size = self._psim, self._psim.n_future, self._belief.shape[1]
        x = np.asarray(observation, dtype=np.float64)
        if x.shape != (self.n, psim.n_obs_):
            raise ValueError(f"observation: expected shape {(self.n, psim.n_obs_)}, got {x.shape}")
        check_finite("observation", x)
        z = psim._scale.apply(x)
        squared = np.square(psim._scale.invert(psim._observe(self._belief)) - x).sum(axis=1)
        following = psim._update(self._belief, z)
        inside = (np.abs(following) <= psim._bound).all(axis=1)
        if not inside.all():
            following = psim._advance(self._belief, z)  # the same within the bounds, which tells it once
        self._met[:, self._slot, :size], self._met[:, self._slot, size:] = self._belief, z
        oldest = (self._slot + 1) % (k + 1)
        complete = np.flatnonzero((self._n_seen >= k) & self._is_inside[:, oldest])
        if len(complete):
            order = (oldest + 1 + np.arange(k)) % (k + 1)
            targets = psim._phi(self._met[complete[:, None], order, size:])
            if psim.target == "delta":
                targets = targets - psim._base(self._met[complete, oldest, size:])
            self._learner.add(self._learner.encode(self._met[complete, oldest]), targets)
        # from here on nothing can fail
        predicted = self._n_seen > 0
        self._squared_error += float(squared[predicted].sum())
        self._n_predicted += int(predicted.sum())
        self._n_seen += 1
        self._n_new += len(complete)
        self._belief, self._slot = following, oldest
        self._is_inside[:, oldest] = inside
        self._n_updates += 1
        if self._n_updates % self.refit_every == 0 and self._n_new:
            self._refit()
        return self.belief

    def predict_observation(self) -> Array:
        """x_hat, the next observation that each stream's belief expects: (n, n_obs)."""
        return self._psim.predict_observation(self._belief)

    def forecast(self, horizon: int) -> Array:
        """The next `horizon` observations that each stream's belief expects: (n, horizon, n_obs)."""
        return self._psim.forecast(self._belief, horizon)

    def reset(self, rows: ArrayLike | None = None) -> Array:
        """Begin an episode: the initial belief again, and no pair with observations from before and after.

        Args:
            rows: which streams, as indices (m,) or a mask (n,) of bool; None for all.

        Returns:
            (n, belief_size), the beliefs of all streams.

        Raises:
            IndexError: a stream that is not there, or a mask of another length.
        """
        chosen = slice(None) if rows is None else self._rows(np.asarray(rows))
        self._belief[chosen] = self._psim.initial_belief()
        self._n_seen[chosen] = 0
        self._is_inside[chosen] = True
        return self.belief

    def filter(self) -> PSIM:
        """The present filter as a PSIM of its own, which later updates do not touch; it only filters.

        Its `history_` and `best_iteration_` are those of the fit.
        """
        return copy(self._psim)

    @property
    def belief(self) -> Array:
        """(n, belief_size) as a copy."""
        return self._belief.copy()

    @property
    def mean_squared_error(self) -> float:
        """Mean of |x_hat_t - x_t|^2 over the streams and t so far, in the data's units squared.

        Each prediction was made before its observation came, by the filter in force then; the first observation after
        a start, which is predicted from nothing, does not count. NaN before there is one.
        """
        return self._squared_error / self._n_predicted if self._n_predicted else float("nan")

    @property
    def squared_error(self) -> float:
        """The sum of which `mean_squared_error` is the mean; that of a fixed filter taken from it is the regret."""
        return self._squared_error

    @property
    def n_predicted(self) -> int:
        """Predictions in `mean_squared_error`."""
        return self._n_predicted

    @property
    def n_pairs(self) -> int:
        """Pairs in the aggregate, those of the fit included."""
        return self._learner.n_pairs

    @property
    def n_refits(self) -> int:
        """Refits so far."""
        return self._n_refits

    def _refit(self) -> None:
        self._learner.refit()
        self._psim.model_ = self._learner.frozen()
        if self.forgetting < 1:
            self._learner.discount(self.forgetting)
        self._n_new = 0
        self._n_refits += 1

    def _rows(self, rows: NDArray[Any]) -> NDArray[Any]:
        if rows.dtype == np.bool_ and rows.shape != (self.n,):
            raise IndexError(f"expected a mask of shape {(self.n,)}, got {rows.shape}")
        if rows.dtype != np.bool_ and not np.issubdtype(rows.dtype, np.integer) and rows.size:
            raise IndexError(f"expected rows as whole numbers or a mask of bool, got {rows.dtype}")
        if rows.dtype != np.bool_ and rows.size and not (-self.n <= rows.min() and rows.max() < self.n):
            raise IndexError(f"expected rows of {self.n} streams, got {rows.tolist()}")
        return rows if rows.size else np.zeros(0, dtype=np.intp)

    def __repr__(self) -> str:
        return (
            f"LearningStream({type(self._psim).__name__}, n={self.n}, refit_every={self.refit_every}, "
            f"forgetting={self.forgetting:g}, n_pairs={self.n_pairs})"
        )
