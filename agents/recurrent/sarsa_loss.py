"""The loss of Recurrent-Q SARSA as a loss module of TorchRL's, to be used alone or by the agents here.

    l_t = sum_{n=0}^{k} w_n |Q_t(x_t, a_t) - y_t^n|^2
    y_t^n = sum_{i=0}^{n} gamma^i r_{t+i} + gamma^{n+1} Q_{t+n+1}(x_{t+n+1}, a_{t+n+1})

Q_t depends on all that was seen up to t through the network's hidden state, which is rolled along the recorded episode:
the actions in it are those that were taken, so the states are those that the policy was in (temporal consistency).

With munchausen alpha > 0 policies change little from one to the next:

    r_t <- r_t + alpha tau log pi(a_t | h_t)        V_t = sum_a pi(a | h_t) [Q_t(x_t, a) - tau log pi(a | h_t)]

which keeps each near the one before (by a divergence of weight alpha tau) and averages errors of Q over iterations.

Reference: thesis proposal, Sec. 4.3.1, Eq. 4.17 and Fig. 4.4; Munos et al. 2016 for the weights of old batches;
Vieillard et al. 2020 for munchausen, their Eqs. 1 and 2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from beliefgym.agents.recurrent.action_choice import action_probabilities
from beliefgym.agents.recurrent.auxiliary import Pieces
from beliefgym.agents.recurrent.bound_loss import BoundLoss
from beliefgym.agents.recurrent.network import RecurrentQNetwork
from beliefgym.agents.recurrent.segments import Segments, batch_segments
from beliefgym.agents.recurrent.targets import (
    lambda_returns,
    lambda_weights,
    n_step_returns,
    step_weights,
)

LEAST_PROBABILITY = 1e-12  # whose logarithm stands for that of 0
Bootstrap = Literal["taken", "expected", "max", "double"]
Gradient = Literal["semi", "residual"]


class RecurrentSarsaLoss(BoundLoss):
    """Bellman residuals of a recurrent Q network along recorded rollouts, with auxiliary objectives.

    The input is a tensordict (n, n_steps) in TorchRL's layout, as a collector or this package's gives it: rows may hold
    several episodes (`is_init`), or be padded ("mask"). What followed an episode's last step is seen by the network
    too, so that a truncation is bootstrapped and a termination is not.

    Args:
        value_network: reads its keys under TorchRL's recurrent mode and writes "action_value" and "hidden"; a
            `RecurrentQNetwork` or a sequence with TorchRL's GRUModule or LSTMModule.
        gamma: discount.
        n_steps: k of the sum over residuals; None for all to the piece's end, as lambda-returns.
        weights: of the k + 1 residuals, or lambda for weights proportional to lambda^n.
        bootstrap: "taken": Q of the action taken next (Eq. 4.17), and of the policy's expectation where none was taken;
            "expected": the policy's expectation (expected SARSA); "max": the largest (Q-learning, PQN); "double": the
            averaged network's value of the network's best action.
        gradient: "residual" minimises Eq. 4.17 through both sides; "semi" holds the target fixed.
        epsilon, temperature: of the policy whose values are learned; plain attributes, to be annealed.
        importance: weight what follows a step by min(1, pi(a | h) / mu(a | h)), mu from "action_probability": for
            batches of older policies. It needs `bootstrap="expected"`.
        munchausen: alpha, from 0 to below 1; it needs `bootstrap="expected"` and a semi-gradient.
        delay_value: bootstrap with target parameters (TorchRL's `SoftUpdate` or `HardUpdate` moves them).
        burn_in: steps at the front of a piece that begins inside an episode that bring up its state, without residuals
            (auxiliary objectives count there too).
        auxiliary: objectives by name. auxiliary_weights: their lambdas; a plain attribute, to be annealed.

    Output:
        "loss_value", "loss_<auxiliary>" (times their weights), and without gradient "td_error" (root mean square),
        "mean_value", "largest_value" (of |Q|).

    Raises:
        ValueError: settings that contradict each other.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the tensordict, to be changed by `set_keys`."""

        action: NestedKey = "action"
        action_value: NestedKey = "action_value"
        hidden: NestedKey = "hidden"
        action_probability: NestedKey = "action_probability"
        recurrent_state: NestedKey = "recurrent_state"
        is_init: NestedKey = "is_init"
        mask: NestedKey = "mask"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        observation: NestedKey = "observation"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    value_network: TensorDictModuleBase
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(
        self,
        value_network: TensorDictModuleBase,
        *,
        gamma: float = 0.99,
        n_steps: int | None = None,
        weights: Sequence[float] | float = 0.9,
        bootstrap: Bootstrap = "taken",
        gradient: Gradient = "semi",
        epsilon: float = 0.0,
        temperature: float = 0.0,
        importance: bool = False,
        munchausen: float = 0.0,
        delay_value: bool = False,
        burn_in: int = 0,
        auxiliary: Mapping[str, nn.Module] | None = None,
        auxiliary_weights: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__()
        _check(gamma, n_steps, weights, bootstrap, gradient, importance, delay_value)
        if not 0.0 <= munchausen < 1.0 or (munchausen and (bootstrap, gradient) != ("expected", "semi")):
            raise ValueError(
                'expected munchausen from 0 to below 1, and above 0 with bootstrap="expected" and gradient="semi", got '
                f"{munchausen} with {bootstrap!r} and {gradient!r}"
            )
        self.convert_to_functional(value_network, "value_network", create_target_params=delay_value)
        self.gamma, self.n_steps, self.weights = gamma, n_steps, weights
        self.bootstrap, self.gradient = bootstrap, gradient
        self.epsilon, self.temperature = epsilon, temperature
        self.importance, self.munchausen = importance, munchausen
        self.delay_value, self.burn_in = delay_value, burn_in
        self.auxiliary = nn.ModuleDict(dict(auxiliary or {}))
        self.auxiliary_weights = {
            name: float((auxiliary_weights or {}).get(name, 1.0)) for name in self.auxiliary
        }

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        del kwargs  # targets are computed here

    @property
    def history_keys(self) -> list[NestedKey]:
        """What the network reads at every step, apart from its state and where episodes begin."""
        own = (self.tensor_keys.recurrent_state, self.tensor_keys.is_init)
        return [key for key in self.value_network.in_keys if key not in own and "recurrent_state" not in key]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """See the class.

        Raises:
            ValueError: a batch that is not (n, n_steps), or has no step that counts.
        """
        if tensordict.ndim != 2:
            raise ValueError(
                f"expected a batch (n, n_steps) of rollouts, got batch size {tuple(tensordict.shape)}"
            )
        keys = self.tensor_keys
        pieces = batch_segments(tensordict, keys.is_init, keys.mask)
        inputs, first = self._slots(tensordict, pieces)
        values, hidden = self._roll(self.bound("value_network"), inputs, first, pieces)
        later, later_hidden = values, hidden
        if self.delay_value:
            with torch.no_grad():
                later, later_hidden = self._roll(self.bound("value_network", "target"), inputs, first, pieces)
        elif self.gradient == "semi":
            later, later_hidden = values.detach(), hidden.detach()
        action = pieces.steps(_categorical(tensordict.get(keys.action), values.shape[-1]))
        rewards = pieces.steps(tensordict.get(("next", keys.reward))[..., 0])
        terminated = pieces.steps(tensordict.get(("next", keys.terminated))[..., 0])
        discounts = self.gamma * (~terminated).to(rewards.dtype)
        if self.munchausen:
            bonus = self.temperature * _of(self._log_policy(later[:, :-1]), action)
            rewards = rewards + self.munchausen * bonus
        chosen = _of(values[:, :-1], action)
        probability = tensordict.get(keys.action_probability, None)
        loss = self._residuals(
            pieces,
            chosen,
            rewards,
            discounts,
            following=self._following(pieces, action, values, later),
            traces=self._traces(pieces, action, later, probability),
            later_chosen=_of(later[:, :-1], action),
        )
        counts = pieces.mask & ((pieces.fresh[:, None]) | (self._position(pieces) >= self.burn_in))
        weights = counts.to(rewards.dtype) / counts.sum().clamp(min=1)
        with torch.no_grad():
            out = {
                "td_error": (loss * weights).sum().sqrt(),
                "mean_value": (chosen * weights).sum(),
                "largest_value": values.abs().max(),
            }
        out["loss_value"] = (loss * weights).sum()
        if any(self.auxiliary_weights.values()):
            given = Pieces(
                hidden,
                later_hidden,
                self._standardised(inputs[keys.observation]),
                nn.functional.one_hot(action, values.shape[-1]).to(rewards.dtype),
                rewards,
                lambda: self._returns(pieces, rewards, discounts, later),
                pieces.mask,
            )
            for name, objective in self.auxiliary.items():
                if weight := self.auxiliary_weights[name]:
                    out[f"loss_{name}"] = weight * objective(given)
        return TensorDict(out, [])

    def _slots(
        self, tensordict: TensorDictBase, pieces: Segments
    ) -> tuple[dict[NestedKey, Tensor], dict[NestedKey, Tensor]]:
        """What the network reads along the pieces and what followed them, and the states that they begin with."""
        inputs: dict[NestedKey, Tensor] = {
            key: pieces.slots(tensordict.get(key), tensordict.get(("next", key))) for key in self.history_keys
        }
        first: dict[NestedKey, Tensor] = {}
        for key in self.value_network.in_keys:
            if "recurrent_state" in key or key == self.tensor_keys.recurrent_state:
                state = tensordict.get(key)[pieces.rows, pieces.starts]
                first[key] = torch.where(pieces.fresh.view(-1, *[1] * (state.ndim - 1)), 0.0, state)
        return inputs, first

    def _roll(
        self,
        network: Any,
        inputs: Mapping[NestedKey, Tensor],
        first: Mapping[NestedKey, Tensor],
        pieces: Segments,
    ) -> tuple[Tensor, Tensor]:
        """Action values and hidden states of every slot; one of the networks here needs no tensordict for it."""
        keys = self.tensor_keys
        if isinstance(network, RecurrentQNetwork):
            values, hidden, _ = network.values(*inputs.values(), *first.values())
            return values, hidden
        n, longest = len(pieces), pieces.mask.shape[1] + 1
        is_init = pieces.fresh.new_zeros(n, longest, 1)
        is_init[:, 0, 0] = pieces.fresh
        states = {key: state[:, None].expand(n, longest, *state.shape[1:]) for key, state in first.items()}
        with set_recurrent_mode(True):
            answer = network(TensorDict({**inputs, **states, keys.is_init: is_init}, [n, longest]))
        return answer.get(keys.action_value), answer.get(keys.hidden)

    def _policy(self, values: Tensor) -> Tensor:
        return action_probabilities(values, self.epsilon, self.temperature)

    def _log_policy(self, values: Tensor) -> Tensor:
        return self._policy(values).clamp(min=LEAST_PROBABILITY).log()

    def _expected(self, values: Tensor) -> Tensor:
        """V of the policy, with its entropy where munchausen rewards it."""
        policy = self._policy(values)
        if self.munchausen:
            values = values - self.temperature * policy.clamp(min=LEAST_PROBABILITY).log()
        return (policy * values).sum(-1)

    def _following(self, pieces: Segments, action: Tensor, values: Tensor, later: Tensor) -> Tensor:
        """V_{t+1} at every step."""
        following = later[:, 1:]
        if self.bootstrap == "max":
            return following.max(-1).values
        if self.bootstrap == "double":
            return _of(following, values[:, 1:].detach().argmax(-1))
        expected = self._expected(following)
        if self.bootstrap == "expected":
            return expected
        taken = _of(following[:, :-1], action[:, 1:])
        taken = torch.cat([taken, expected[:, -1:]], dim=1)
        return torch.where(pieces.is_last, expected, taken)

    def _traces(
        self, pieces: Segments, action: Tensor, later: Tensor, probability: Tensor | None
    ) -> Tensor | None:
        """min(1, pi / mu) of the action at each step; None where nothing is weighted."""
        if not self.importance:
            return None
        if probability is None:
            raise ValueError(
                f"importance weights need the probability of each action when it was taken, under "
                f"{self.tensor_keys.action_probability!r}; let the collector record it, or set importance=False"
            )
        behaviour = pieces.steps(probability[..., 0] if probability.ndim == 3 else probability)
        return (_of(self._policy(later[:, :-1]), action) / behaviour).clamp(max=1.0)

    def _residuals(
        self,
        pieces: Segments,
        chosen: Tensor,
        rewards: Tensor,
        discounts: Tensor,
        following: Tensor,
        traces: Tensor | None,
        later_chosen: Tensor,
    ) -> Tensor:
        """(n_pieces, n_steps) l_t."""
        if self.n_steps is None and self.gradient == "semi":
            weight = float(self.weights)  # type: ignore[arg-type]
            carried = weight * (~pieces.is_last).to(rewards.dtype)
            anchors = _shifted(later_chosen) if self.bootstrap in ("taken", "expected") else following
            if traces is not None:
                carried = carried * _shifted(traces)
            targets = lambda_returns(rewards, discounts, following, carried, anchors)
            return (chosen - targets).square()
        k = chosen.shape[1] - 1 if self.n_steps is None else self.n_steps
        targets_of_n = n_step_returns(rewards, discounts, following, pieces.is_last, k)
        total = torch.zeros_like(chosen)
        if self.n_steps is None:
            shares = lambda_weights(k, float(self.weights))  # type: ignore[arg-type]
        else:
            shares = step_weights(k, self.weights)
        for weight, target in zip(shares, targets_of_n, strict=True):
            if weight > 0.0:
                total = total + weight * (chosen - target).square()
        return total

    @torch.no_grad()
    def _returns(self, pieces: Segments, rewards: Tensor, discounts: Tensor, later: Tensor) -> Tensor:
        """The discounted rewards to the end of each piece, and the policy's value there."""
        expected = self._expected(later[:, 1:])
        carried = (~pieces.is_last).to(rewards.dtype)
        return lambda_returns(rewards, discounts, expected, carried, expected)

    def _standardised(self, observation: Tensor) -> Tensor:
        encoder: Any = getattr(self.value_network, "encoder", None)
        return encoder.standardised(observation) if hasattr(encoder, "standardised") else observation

    @staticmethod
    def _position(pieces: Segments) -> Tensor:
        return torch.arange(pieces.mask.shape[1], device=pieces.mask.device)


def _of(values: Tensor, action: Tensor) -> Tensor:
    """(n, n_steps, n_actions), (n, n_steps) -> the action's values."""
    return values.gather(-1, action[..., None])[..., 0]


def _shifted(x: Tensor) -> Tensor:
    """x_{t+1} at t; the last column is repeated, and must not count."""
    return torch.cat([x[:, 1:], x[:, -1:]], dim=1)


def _categorical(action: Tensor, n_actions: int) -> Tensor:
    """Numbers of actions, from numbers (n, n_steps), (n, n_steps, 1), or one-hot (n, n_steps, n_actions)."""
    if action.ndim == 2:
        return action.long()
    return action.argmax(-1) if action.shape[-1] == n_actions else action[..., 0].long()


def _check(
    gamma: float,
    n_steps: int | None,
    weights: Sequence[float] | float,
    bootstrap: str,
    gradient: str,
    importance: bool,
    delay_value: bool,
) -> None:
    if not 0.0 <= gamma <= 1.0:
        raise ValueError(f"expected gamma from 0 to 1, got {gamma}")
    if bootstrap not in ("taken", "expected", "max", "double") or gradient not in ("semi", "residual"):
        raise ValueError(
            'expected bootstrap "taken", "expected", "max" or "double" and gradient "semi" or "residual", got '
            f"{bootstrap!r} and {gradient!r}"
        )
    if n_steps is None and not isinstance(weights, float | int):
        raise ValueError(
            "weights of your own need n_steps; to a piece's end they are powers of lambda, one number"
        )
    if n_steps is not None:
        step_weights(n_steps, weights)
    if gradient == "residual" and delay_value:
        raise ValueError(
            'gradient="residual" goes through both sides, and target parameters have no gradient: take '
            'delay_value=False, or gradient="semi"'
        )
    if bootstrap == "double" and not delay_value:
        raise ValueError('bootstrap="double" needs the target parameters of delay_value=True')
    if importance and (bootstrap != "expected" or n_steps is not None or gradient == "residual"):
        raise ValueError(
            'importance weights correct lambda-returns with the policy\'s expectation: take bootstrap="expected", '
            'n_steps=None and gradient="semi"'
        )
