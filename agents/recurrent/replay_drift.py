"""How far off the hidden states are that are learned from out of a replay memory.

    sqrt( sum_t |h'_t - h_t|^2 / sum_t |h_t|^2 )

h_t is what the present network comes to from an episode's start, h'_t what an update sees: the network rolled over
`burn_in` steps from a zero or a stored state, then over the steps that are learned from, which are those that count.
"""

from __future__ import annotations

import torch

from beliefgym.agents.recurrent.network import HISTORY_KEYS, HistoryEncoder
from beliefgym.agents.recurrent.replay import EpisodeReplay

EPISODES = 16  # that are drawn for it
EVERY = 16  # rollouts


@torch.no_grad()
def replay_drift(
    encoder: HistoryEncoder,
    replay: EpisodeReplay,
    generator: torch.Generator,
    *,
    length: int,
    burn_in: int = 0,
    stored: bool = False,
) -> float:
    """The relative error of hidden states, 0 where updates begin with episodes.

    Args:
        encoder: of the network that learns. replay: with episodes in it. generator: of the draw.
        length, burn_in: steps of an update. stored: from the "recurrent_state" of the replay; False from zeros.
    """
    episodes = replay.episodes(EPISODES, generator)
    lengths = episodes["mask"].sum(1)
    n, longest = episodes["mask"].shape
    inputs = [episodes[key] for key in HISTORY_KEYS]
    first = inputs[0].new_zeros(n, encoder.memory.state_size)
    true, _ = encoder(*inputs, first)
    steps = (torch.rand(n, generator=generator) * lengths).long()  # the first that is learned from
    starts = (steps - burn_in).clamp(min=0)
    rows = torch.arange(n)[:, None]
    times = starts[:, None] + torch.arange(burn_in + length)
    counts = (times < lengths[:, None]) & (times >= steps[:, None]) & (times < steps[:, None] + length)
    times = times.clamp(max=longest - 1)
    if stored:
        first = torch.where((starts == 0)[:, None], 0.0, episodes["recurrent_state"][rows[:, 0], starts])
    seen, _ = encoder(*(x[rows, times] for x in inputs), first)
    there = counts[..., None].to(true.dtype)
    size = float((true[rows, times].square() * there).sum())
    return (float(((seen - true[rows, times]).square() * there).sum()) / size) ** 0.5 if size > 0.0 else 0.0
