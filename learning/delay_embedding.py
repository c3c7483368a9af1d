"""`delay_embedding`: the last k observations as one, where a single one does not hold the state.

    y_t = (x_t, x_{t-1}, .., x_{t-k+1}),     t = k - 1 .. L

Positions without velocities, or a frame of a video, become a state that a one-step model can predict. Takens' theorem
says when enough delays do (F. Takens, "Detecting strange attractors in turbulence", 1981).
"""

from __future__ import annotations

import numpy as np

from beliefgym.learning.sequences import Sequences
from beliefgym.learning.windows import check_positive


def delay_embedding(sequences: Sequences, n_delays: int) -> Sequences:
    """Trajectories whose observations are the last n_delays observations, the newest first.

    Episodes become n_delays - 1 steps shorter: the first observation that has all its past is the first of the new one.
    Actions, rewards, states and hints keep their times.

    Args:
        sequences: every episode of at least n_delays - 1 steps.
        n_delays: k, at least 1; 1 gives the sequences themselves.

    Returns:
        Observations (n_episodes, n_steps - k + 2, k n_obs), named "x", "x[-1]", ..

    Raises:
        ValueError: n_delays below 1, or an episode that is too short, named.
    """
    check_positive("n_delays", n_delays)
    if n_delays == 1:
        return sequences
    lost = n_delays - 1
    short = np.flatnonzero(sequences.lengths < lost)
    if len(short):
        raise ValueError(
            f"expected episodes of at least {lost} steps for {n_delays} delays, got {len(short)} shorter ones, the "
            f"first episode {short[0]} of {sequences.lengths[short[0]]} steps; leave them out"
        )
    n_rows = sequences.n_steps + 1 - lost
    observations = [sequences.observations[:, lost - d : lost - d + n_rows] for d in range(n_delays)]
    names = sequences.observation_names
    return Sequences(
        np.concatenate(observations, axis=2),
        sequences.actions[:, lost:],
        sequences.rewards[:, lost:],
        lengths=sequences.lengths - lost,
        terminated=sequences.terminated,
        states=None if sequences.states is None else sequences.states[:, lost:],
        hints=None if sequences.hints is None else sequences.hints[:, lost:],
        action_log_probs=None if sequences.action_log_probs is None else sequences.action_log_probs[:, lost:],
        observation_names=None
        if names is None
        else [name if d == 0 else f"{name}[-{d}]" for d in range(n_delays) for name in names],
        action_names=sequences.action_names,
        state_names=sequences.state_names,
        hint_names=sequences.hint_names,
        metadata={**sequences.metadata, "n_delays": int(n_delays)},
    )
