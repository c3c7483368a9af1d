"""What every learned dynamics model shares: coordinates, single steps, rollouts and their errors.

A model maps a state and an action to the next state, x_{t+1} = f(x_t, u_t), either directly or by the difference
Delta_t = x_{t+1} - x_t (Eq. 3.14), and predicts many steps by feeding its predictions back (Eq. 3.5). Inside, states
and actions are standardised by the training data, so that a ridge or a kernel bandwidth means the same for metres and
radians.

Reference: thesis proposal, Secs. 3.1.1 and 3.2.3.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from sklearn.exceptions import NotFittedError

from beliefgym.learning.multi_step_error import MultiStepErrors, multi_step_errors
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
Target = Literal["delta", "next"]
Standardise = bool | Literal["together"]
STANDARDISATIONS: dict[Standardise, Callable[[Array], Standardisation]] = {
    True: Standardisation.of,
    "together": Standardisation.together,
    False: Standardisation.none,
}


class DivergenceWarning(UserWarning):
    """Predictions left every reasonable range and were cut there."""


class DynamicsModel(BaseEstimator, ABC):
    """Base of the dynamics models: `fit(train, validation)`, `predict`, `rollout`, `errors`.

    A subclass has the parameters target, standardise, use_actions and divergence_limit, and implements `fit` and
    `_step`. One that has `angles` too, components in rad that mean the same a turn later, puts its regressor's inputs
    together with `_inputs`: each angle enters as its cosine and sine, and differences of angles are taken to
    [-pi, pi).

    Attributes:
        n_obs_, n_act_: components of states and actions (0 where actions are not used).
    """

    target: Target
    standardise: Standardise
    use_actions: bool
    divergence_limit: float
    angles: Collection[int] | None = None
    _fitted_attribute = "model_"  # there once a fit has given something to predict with

    @abstractmethod
    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Learn from trajectories; see the subclass."""

    @abstractmethod
    def _step(self, z: Array, u: Array) -> Array:
        """Next states: standardised states (n, n_obs) and actions (n, n_act) -> (n, n_obs)."""

    def predict(self, observations: ArrayLike, actions: ArrayLike | None = None) -> Array:
        """One step: (n, n_obs) and, where the model takes actions, (n, n_act) -> (n, n_obs).

        Raises:
            NotFittedError, ValueError: not fitted; shapes or NaN.
        """
        self._check_fitted()
        x = _rows("observations", observations, self.n_obs_)
        return self._observed.invert(
            self._step(self._observed.apply(x), self._actions_of(actions, (len(x),)))
        )

    def rollout(self, initial_states: ArrayLike, n_steps: int, actions: ArrayLike | None = None) -> Array:
        """Many steps, each from the last prediction (Eq. 3.5), all trajectories at once.

        A trajectory that leaves `divergence_limit` standard deviations of the training data, or becomes infinite,
        stays at its last prediction inside; a `DivergenceWarning` says how many and when the first.

        Args:
            initial_states: (n, n_obs), or (n_obs,) for one trajectory.
            n_steps: steps to predict.
            actions: (n, n_steps, n_act), or (n_steps, n_act) for one trajectory.

        Returns:
            (n, n_steps + 1, n_obs), or (n_steps + 1, n_obs); the first row is the initial state.
        """
        self._check_fitted()
        single = np.ndim(initial_states) == 1
        x = _rows("initial_states", np.atleast_2d(np.asarray(initial_states, dtype=float)), self.n_obs_)
        if isinstance(n_steps, bool) or not isinstance(n_steps, int | np.integer) or n_steps < 0:
            raise ValueError(f"expected n_steps to be a whole number of at least 0, got {n_steps!r}")
        if single and actions is not None:
            actions = np.asarray(actions, dtype=float)[None]
        u = self._actions_of(actions, (len(x), int(n_steps)))
        z, cut = self._forecast(self._observed.apply(x), u)
        if (cut < n_steps).any():
            first = int(np.argmin(cut))
            warnings.warn(
                f"{np.count_nonzero(cut < n_steps)} of {len(x)} rollouts diverged and were cut, the first (trajectory "
                f"{first}) in step {cut[first] + 1} of {n_steps}; they stay at their last prediction inside "
                f"{self.divergence_limit:g} standard deviations of the training data",
                DivergenceWarning,
                stacklevel=2,
            )
        predicted = self._observed.invert(z)
        predicted[:, 0] = x
        return predicted[0] if single else predicted

    def flow(self, observations: Array, actions: Array) -> Array:
        """`predict` for any leading shape and without checks, for planners: what diverges comes back as NaN.

        Args:
            observations: (..., n_obs). actions: (..., n_act).

        Returns:
            (..., n_obs).
        """
        leading = observations.shape[:-1]
        z = self._observed.apply(observations.reshape(-1, self.n_obs_))
        u = self._acted.apply(actions.reshape(len(z), actions.shape[-1])[:, : self.n_act_])
        return self._observed.invert(self._step(z, u)).reshape(*leading, self.n_obs_)

    def errors(self, sequences: Sequences) -> MultiStepErrors:
        """Multi-step errors: each trajectory predicted from its first observation, with its own actions.

        Raises:
            NotFittedError, ValueError: not fitted; other components than at fit.
        """
        self._check_fitted()
        z, u = self._coordinates(sequences)
        predicted, cut = self._forecast(z[:, 0], u)
        return self._errors(predicted, sequences, int(np.count_nonzero(cut < sequences.lengths)))

    def single_step_error(self, sequences: Sequences) -> float:
        """Root mean square of the one-step errors |f(x_t, u_t) - x_{t+1}|, over all steps, in the data's units."""
        self._check_fitted()
        if not sequences.n_transitions:
            raise ValueError(f"expected at least one step to predict, got {sequences!r}")
        z, u = self._coordinates(sequences)
        episode, time = np.nonzero(sequences.step_mask)
        predicted = self._observed.invert(self._step(z[episode, time], u[episode, time]))
        error = self._difference(predicted, sequences.observations[episode, time + 1])
        return float(np.sqrt(np.square(error).sum(axis=1).mean()))

    def _begin(self, train: Sequences, validation: Sequences | None = None) -> None:
        """Check the data and take the coordinates from those to train on."""
        for sequences in (train,) if validation is None else (train, validation):
            if not isinstance(sequences, Sequences):
                raise TypeError(
                    f"expected Sequences, got {type(sequences).__name__}; arrays go through "
                    "Sequences.from_observations(observations, actions=...)"
                )
        if self.target not in ("delta", "next"):
            raise ValueError(f"expected target to be 'delta' or 'next', got {self.target!r}")
        if not self.divergence_limit > 0:
            raise ValueError(f"expected divergence_limit above 0, got {self.divergence_limit!r}")
        if not train.n_transitions:
            raise ValueError(f"expected at least one step to learn from, got {train!r}")
        if validation is not None and not validation.n_transitions:
            raise ValueError(f"expected at least one step to validate on, got {validation!r}")
        self.n_obs_, self.n_act_ = train.n_obs, train.n_act if self.use_actions else 0
        rows = train.observations[train.observation_mask]
        spread = Standardisation.of(rows)
        steps = train.actions[train.step_mask][:, : self.n_act_]
        scaled = STANDARDISATIONS.get(self.standardise)
        if scaled is None:
            raise ValueError(
                f"expected standardise to be one of {list(STANDARDISATIONS)}, got {self.standardise!r}"
            )
        self._turns = self._checked_angles()
        self._observed, self._acted = scaled(rows), scaled(steps)
        self._observed.offset[self._turns] = 0.0
        self._observed.scale[self._turns] = 1.0
        spread.scale[self._turns] = np.maximum(spread.scale[self._turns], np.pi)
        for what, names, constant in (
            ("observations", train.observation_names, spread.constant),
            ("actions", train.action_names, Standardisation.of(steps).constant),
        ):
            if constant.any():
                told = [names[i] if names else int(i) for i in np.flatnonzero(constant)]
                warnings.warn(
                    f"{what} {told} do not vary in the training data: nothing can be learned of them, they get scale 1",
                    stacklevel=3,
                )
        self._centre, self._spread = self._observed.apply(spread.offset), spread.scale / self._observed.scale
        episode, time = np.nonzero(train.step_mask)
        z = self._observed.apply(train.observations)
        change = self._difference(z[episode, time + 1], z[episode, time])
        scaled = Standardisation.together if self.standardise == "together" else Standardisation.of
        self._change_scale = scaled(change).scale if self.target == "delta" else np.ones(self.n_obs_)

    def _coordinates(self, sequences: Sequences) -> tuple[Array, Array]:
        """Standardised states (n, n_steps + 1, n_obs) and actions (n, n_steps, n_act)."""
        n_act = sequences.n_act if self.use_actions else 0
        if (sequences.n_obs, n_act) != (self.n_obs_, self.n_act_):
            raise ValueError(
                f"expected trajectories with {self.n_obs_} observations and {self.n_act_} actions as at fit, got "
                f"{sequences.n_obs} and {n_act}"
            )
        return (
            self._observed.apply(sequences.observations),
            self._acted.apply(sequences.actions[:, :, : self.n_act_]),
        )

    def _targets(self, z: Array, z_next: Array) -> Array:
        """What the regressor is to give at state z so that the next state is z_next; (n, n_obs)."""
        return self._difference(z_next, z) / self._change_scale if self.target == "delta" else z_next

    def _next(self, z: Array, output: Array) -> Array:
        """The next state from the regressor's output at state z; (n, n_obs)."""
        return z + output * self._change_scale if self.target == "delta" else output

    def _inputs(self, z: Array, u: Array) -> Array:
        """What a regressor is given: (n, n_obs) and (n, n_act) -> (n, n_obs + number of angles + n_act).

        Angles give way to their cosines, in place, and their sines stand after the states.
        """
        if not len(self._turns):
            return np.concatenate([z, u], axis=1)
        turned = z[:, self._turns]
        inputs = np.concatenate([z, np.sin(turned), u], axis=1)
        inputs[:, self._turns] = np.cos(turned)
        return inputs

    def _difference(self, a: Array, b: Array) -> Array:
        """a - b with the differences of angles in [-pi, pi); (..., n_obs)."""
        difference = a - b
        if len(self._turns):
            turned = difference[..., self._turns]
            difference[..., self._turns] = turned - 2.0 * np.pi * np.floor(turned / (2.0 * np.pi) + 0.5)
        return difference

    def _checked_angles(self) -> NDArray[np.int64]:
        """(k,) the numbers of the components that are angles."""
        angles = [] if self.angles is None else sorted(self.angles)
        for angle in angles:
            if (
                isinstance(angle, bool)
                or not isinstance(angle, int | np.integer)
                or not 0 <= angle < self.n_obs_
            ):
                raise ValueError(
                    f"expected angles as numbers of components, 0 to {self.n_obs_ - 1}, got {angle!r}"
                )
        if angles and self.target != "delta":
            raise ValueError(
                "expected target='delta' with angles: a difference of angles has no jump, an angle has"
            )
        return np.array(angles, dtype=np.int64)

    def _inside(self, z: Array) -> NDArray[np.bool_]:
        """(n,) which states are finite and within the divergence limit."""
        with np.errstate(invalid="ignore", over="ignore"):
            inside: NDArray[np.bool_] = np.abs(z - self._centre) <= self.divergence_limit * self._spread
        return np.asarray(inside.all(axis=-1))

    def _forecast(self, z: Array, u: Array) -> tuple[Array, NDArray[np.int64]]:
        """Predict from z (n, n_obs) with actions (n, n_steps, n_act).

        Returns:
            (n, n_steps + 1, n_obs), and (n,) the number of steps before each was cut (n_steps if it was not).
        """
        n_steps = u.shape[1]
        predicted = np.empty((len(z), n_steps + 1, z.shape[1]))
        predicted[:, 0] = z
        cut = np.full(len(z), n_steps)
        going = np.arange(len(z))
        for t in range(n_steps):
            predicted[:, t + 1] = predicted[:, t]
            if not len(going):
                continue
            z_next = self._step(predicted[going, t], u[going, t])
            inside = self._inside(z_next)
            if not inside.all():
                cut[going[~inside]] = t
                going, z_next = going[inside], z_next[inside]
            predicted[going, t + 1] = z_next
        return predicted, cut

    def _errors(self, predicted: Array, sequences: Sequences, n_diverged: int) -> MultiStepErrors:
        truth = sequences.observations
        states = self._observed.invert(predicted)
        if len(self._turns):
            states = truth + self._difference(states, truth)
        return multi_step_errors(states, truth, sequences.lengths, n_diverged)

    def _actions_of(self, actions: ArrayLike | None, shape: tuple[int, ...]) -> Array:
        """Standardised actions of the shape (*shape, n_act)."""
        if actions is None:
            if self.n_act_:
                raise ValueError(f"expected actions of shape {(*shape, self.n_act_)}, got None")
            return np.zeros((*shape, 0))
        if not self.n_act_:
            raise ValueError("expected no actions: this model was fitted without")
        array = np.asarray(actions, dtype=np.float64)
        if array.shape != (*shape, self.n_act_):
            raise ValueError(f"expected actions of shape {(*shape, self.n_act_)}, got {array.shape}")
        _check_finite("actions", array)
        return self._acted.apply(array)

    def _check_fitted(self) -> None:
        if not self.__sklearn_is_fitted__():
            raise NotFittedError(f"this {type(self).__name__} is not fitted yet; call fit(train, validation)")

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "n_obs_") and hasattr(self, self._fitted_attribute)


def _rows(what: str, value: Any, n_components: int) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != n_components:
        raise ValueError(f"{what}: expected shape (n, {n_components}), got {array.shape}")
    _check_finite(what, array)
    return array


def _check_finite(what: str, array: Array) -> None:
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{what}: expected finite numbers, got {array[where]} at index {where}")
