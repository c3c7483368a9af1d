"""Policies that explore by a known law, so that `collect` records the log-probability of what they do.

    GaussianPolicy            a = mu(x) + std eps, eps ~ N(0, I)     p(a | x) = N(a; mu(x), diag std^2)
    EpsilonPolicy, Discrete   p(a | x) = epsilon / n + (1 - epsilon) [a = pi(x)]
    EpsilonPolicy, Box        p(a | x) = epsilon [a in box] / volume + (1 - epsilon) N(a; pi(x), diag std^2)

The density is that of the action as it is recorded, which is not clipped. An environment of this package clips inside
itself: it reacts to an action outside its bounds as to the bound. That reaction is the same function of the recorded
action whoever acts, and cancels in the ratio of two policies' probabilities of an episode; so importance weights stay
right. An action that was clipped before would stand at a bound with a probability above 0, where there is no density.
(Gymnasium's locomotion tasks charge for the size of the action as it was given, not as it was clipped.)

Under `collect` these policies draw and tell their log-probabilities always, also with its deterministic=True: to
explore is what they are for. `deterministic` goes to the policy inside. One that is random itself gives a random mu(x),
and the density is that given mu(x): weights 1 / p(a | x) are still unbiased.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, Space
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.acting import Predictor

Array = NDArray[np.float64]
_STREAM = 2  # a stream apart from the environment's (none) and the random policy's (1) of the same seed


class ExploringPolicy(ABC):
    """What the two have in common: the policy inside, its memory, and a random stream.

    Two calls with the same arguments draw anew; a second policy with the same seed draws the same again.
    """

    explores_always = True

    def __init__(
        self, policy: Predictor | Callable[[Any], Any] | None, shape: tuple[int, ...] | None, seed: int
    ) -> None:
        if not (policy is None or callable(getattr(policy, "predict", None)) or callable(policy)):
            raise TypeError(
                "expected a policy that is None, a function of observations, or an object with "
                f"predict(observation, state, episode_start, deterministic), got {policy!r}"
            )
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise ValueError(f"expected seed to be a whole number of at least 0, got {seed!r}")
        self._policy: Any = policy
        self._name = getattr(policy, "__qualname__", type(policy).__name__)
        self._shape = shape
        self._rng = np.random.default_rng(np.random.SeedSequence(int(seed), spawn_key=(_STREAM,)))

    @abstractmethod
    def predict_with_log_prob(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[Any], Any, Array]:
        """Draw actions for a batch of observations.

        Args:
            observation: (n, ...).
            state: memory of the policy inside, as the last call returned it; None at first.
            episode_start: (n,) bool: where a new episode has begun.
            deterministic: for the policy inside; the exploration stays.

        Returns:
            actions (n, ...), the memory of the policy inside, and the log-probabilities (n,).

        Raises:
            ValueError: the policy inside gives actions of the wrong shape, or none that are finite.
        """

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[Any], Any]:
        """The actions and the memory of `predict_with_log_prob`."""
        return self.predict_with_log_prob(observation, state, episode_start, deterministic)[:2]

    def _followed(
        self, observation: Any, state: Any, episode_start: Any, deterministic: bool
    ) -> tuple[NDArray[Any], Any]:
        """Actions of the policy inside, (n, k), and its memory."""
        n, shape = len(observation), self._shape
        if self._policy is None:
            return np.zeros((n, _size(shape or ()))), None
        if callable(getattr(self._policy, "predict", None)):
            action, state = self._policy.predict(
                observation, state=state, episode_start=episode_start, deterministic=deterministic
            )
        else:
            action, state = self._policy(observation), None
        array = np.asarray(action)
        if shape is None:
            right = array.ndim == 2 and len(array) == n
        else:
            right = array.shape in ((n, *shape), (n, _size(shape)))
        if not right:
            expected = f"({n}, number of actions)" if shape is None else f"{(n, *shape)}"
            raise ValueError(f"expected actions of shape {expected} from {self._name}, got {array.shape}")
        if array.dtype.kind not in "fiub" or not np.isfinite(array).all():
            raise ValueError(
                f"expected finite numbers as actions from {self._name}, got {array}; look at the policy and at "
                "the observation it was given"
            )
        return array.reshape(n, -1), state


class GaussianPolicy(ExploringPolicy):
    """a = mu(x) + std eps with eps ~ N(0, I): a policy, or zero, with white noise.

    Args:
        policy: mu: a function of observations (n, n_obs) to actions (n, n_act), an object with Stable-Baselines3's
            `predict` (its memory is carried along), or None for zeros.
        std: standard deviation in the action's units, above 0: one number or (n_act,).
        seed: of the noise, at least 0.
        action_space: a Box: number, shape and dtype of the actions; its bounds are not used. Without it the
            number is taken from std or from the policy, and actions are float32, as nearly every environment's are.
            Actions are rounded to the dtype first, so that the density is that of the action as recorded.

    Raises:
        TypeError: a policy of none of these forms.
        ValueError: std not above 0 or not one for each action, an action space that is not a Box of floating-point
            numbers, or no way to tell the number of actions.
    """

    def __init__(
        self,
        policy: Predictor | Callable[[Any], Any] | None,
        std: ArrayLike,
        *,
        seed: int,
        action_space: Space[Any] | None = None,
    ) -> None:
        shape = None if action_space is None else _real_box(action_space, "GaussianPolicy").shape
        self._std = _checked_std(std, shape)
        if shape is None and self._std.ndim:
            shape = self._std.shape
        if shape is None and policy is None:
            raise ValueError(
                "expected action_space, or std of shape (n_act,), where policy is None: a std of one number does "
                "not say how many actions there are"
            )
        self._dtype = np.dtype(np.float32) if action_space is None else np.dtype(action_space.dtype)
        super().__init__(policy, shape, seed)

    def predict_with_log_prob(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[Any], Any, Array]:
        """See `ExploringPolicy.predict_with_log_prob`."""
        mean, state = self._followed(observation, state, episode_start, deterministic)
        action = (mean + self._std * self._rng.standard_normal(mean.shape)).astype(self._dtype)
        shaped = action.reshape(len(mean), *(self._shape or mean.shape[1:]))
        return shaped, state, _log_normal(action, mean, self._std)


class EpsilonPolicy(ExploringPolicy):
    """With probability epsilon a uniform draw from the action space, else the policy's action.

    The draw is made for each row of a batch by itself.

    Args:
        policy: as in `GaussianPolicy`; on a Discrete space it gives whole numbers and may not be None.
        epsilon: probability of the uniform draw, within 0..1. With 0 < epsilon every action has a chance, which
            importance weighting and off-policy evaluation need.
        action_space: Discrete, or a bounded Box of floating-point numbers.
        seed: of the draws, at least 0.
        std: standard deviation about the policy's action, one number or (n_act,), above 0; needed on a Box, where
            the policy's action by itself would be a point with a probability above 0, which has no density.

    Raises:
        TypeError: a policy of none of these forms.
        ValueError: epsilon outside 0..1, another or an unbounded action space, std missing on a Box or given on
            a Discrete space.
    """

    def __init__(
        self,
        policy: Predictor | Callable[[Any], Any] | None,
        epsilon: float,
        *,
        action_space: Space[Any],
        seed: int,
        std: ArrayLike | None = None,
    ) -> None:
        if not 0.0 <= epsilon <= 1.0:
            raise ValueError(f"expected epsilon within 0..1, got {epsilon!r}")
        self._epsilon, self._space = float(epsilon), action_space
        if isinstance(action_space, Discrete):
            if std is not None:
                raise ValueError(f"expected std None, since {action_space} has no distances, got {std!r}")
            if policy is None:
                raise ValueError(f'expected a policy on {action_space}, got None; policy="random" is uniform')
        else:
            box = _real_box(action_space, "EpsilonPolicy")
            if not (box.is_bounded() and (box.high > box.low).all()):
                raise ValueError(
                    f"expected an action space with bounds, which a uniform draw needs, got {box}; give "
                    "gymnasium.spaces.Box(low, high), or take GaussianPolicy"
                )
            if std is None:
                raise ValueError(
                    f"expected std above 0 on {box}, got None: an action that is the policy's own with probability "
                    "1 - epsilon is a point and has no density; give std, the spread about the policy's action"
                )
            self._std = _checked_std(std, box.shape)
            self._low, self._high = (np.asarray(b, dtype=np.float64).ravel() for b in (box.low, box.high))
        super().__init__(policy, action_space.shape or (), seed)

    def predict_with_log_prob(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[Any], Any, Array]:
        """See `ExploringPolicy.predict_with_log_prob`."""
        followed, state = self._followed(observation, state, episode_start, deterministic)
        if isinstance(self._space, Discrete):
            greedy = _whole_numbers(followed[:, 0], self._space, self._name)
            action, log_prob = epsilon_greedy(greedy, self._space, self._epsilon, self._rng)
            return action, state, log_prob
        uniform = self._rng.random(len(followed)) < self._epsilon
        drawn = self._low + (self._high - self._low) * self._rng.random(followed.shape)
        near = followed + self._std * self._rng.standard_normal(followed.shape)
        action = np.where(uniform[:, None], drawn, near).astype(self._space.dtype)
        inside = ((action >= self._low) & (action <= self._high)).all(axis=1)
        with np.errstate(divide="ignore"):  # log 0 = -inf is meant
            log_uniform = np.log(self._epsilon * inside) - np.log(self._high - self._low).sum()
            log_near = np.log(1.0 - self._epsilon) + _log_normal(action, followed, self._std)
        shaped = action.reshape(len(action), *(self._space.shape or ()))
        return shaped, state, np.logaddexp(log_uniform, log_near)


def epsilon_greedy(
    greedy: NDArray[np.int64], space: Discrete[Any], epsilon: float, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """Each row's greedy action or, with probability epsilon, a uniform one; with the log-probabilities.

    p(a) = epsilon / n + (1 - epsilon) [a = greedy]

    Args:
        greedy: (n,) actions of the policy.
        space: the action space.
        epsilon: within 0..1.
        rng: where the draws come from.

    Returns:
        actions (n,), log-probabilities (n,).
    """
    uniform = rng.random(len(greedy)) < epsilon
    drawn = int(space.start) + rng.integers(int(space.n), size=len(greedy))
    action = np.where(uniform, drawn, greedy)
    return action, np.log(epsilon / int(space.n) + (1.0 - epsilon) * (action == greedy))


def _whole_numbers(action: NDArray[Any], space: Discrete[Any], name: str) -> NDArray[np.int64]:
    """The actions as integers, if the space holds them all."""
    low, high = int(space.start), int(space.start + space.n) - 1
    if (action != np.floor(action)).any() or ((action < low) | (action > high)).any():
        raise ValueError(f"expected whole numbers from {low} to {high} as actions from {name}, got {action}")
    return action.astype(np.int64)


def _log_normal(action: NDArray[Any], mean: NDArray[Any], std: Array) -> Array:
    """(n,) log N(action; mean, diag std^2)."""
    z = (action.astype(np.float64) - mean) / std
    log_prob: Array = -(0.5 * (z**2 + np.log(2.0 * np.pi)) + np.log(std)).sum(axis=1)
    return log_prob


def _checked_std(std: ArrayLike, shape: tuple[int, ...] | None) -> Array:
    """() or (k,), finite and above 0, with one number for each action."""
    array = np.array(std, dtype=np.float64)
    fits = array.ndim < 2 if shape is None else array.shape in ((), shape, (_size(shape),))
    if not (fits and np.isfinite(array).all() and (array > 0).all()):
        each = "(n_act,)" if shape is None else f"{shape}"
        raise ValueError(f"expected std finite and above 0, one number or of shape {each}, got {std!r}")
    return array if array.ndim == 0 else array.ravel()


def _real_box(space: Space[Any], who: str) -> Box:
    """The space, if it is a Box of floating-point numbers."""
    if not (isinstance(space, Box) and np.issubdtype(space.dtype, np.floating)):
        also = "a Discrete space or " if who == "EpsilonPolicy" else ""
        instead = "" if also else "; EpsilonPolicy explores on a Discrete space"
        raise ValueError(f"{who} needs {also}a Box of floating-point numbers, got {space}{instead}")
    return space


def _size(shape: tuple[int, ...]) -> int:
    """Number of components."""
    return int(np.prod(shape))
