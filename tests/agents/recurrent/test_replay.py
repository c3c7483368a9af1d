"""The replay of episodes: what is drawn lies within one episode, and each is drawn as often as is said."""

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict

from beliefgym.agents.recurrent.replay import EpisodeReplay

LEAST_P = 1e-3  # of a chi-square test with a fixed seed


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def stream(lengths, n_steps):
    """Copies whose episodes have these lengths (a list for each); observations are (copy, episode, step)."""
    observation = torch.zeros(len(lengths), n_steps + 1, 3)
    is_init = torch.zeros(len(lengths), n_steps, 1, dtype=torch.bool)
    following = torch.zeros(len(lengths), n_steps, 3)
    for copy, own in enumerate(lengths):
        steps = [(copy, episode, step) for episode, length in enumerate(own) for step in range(length)]
        assert len(steps) >= n_steps, "the lengths given do not fill the rollout"
        observation[copy, :n_steps] = torch.tensor(steps[:n_steps], dtype=torch.float32)
        is_init[copy, :, 0] = observation[copy, :n_steps, 2] == 0
        following[copy] = observation[copy, :n_steps] + torch.tensor([0.0, 0.0, 1.0])
    time = torch.arange(n_steps, dtype=torch.float32).expand(len(lengths), n_steps)
    return TensorDict(
        {
            "observation": observation[:, :n_steps],
            "is_init": is_init,
            "recurrent_state": torch.stack([observation[:, :n_steps, 0], time], dim=-1),
            "next": TensorDict({"observation": following}, [len(lengths), n_steps]),
        },
        [len(lengths), n_steps],
    )


def filled(lengths, n_steps, capacity=10_000, chunk=4):
    replay = EpisodeReplay(capacity)
    for rollout in stream(lengths, n_steps).split(chunk, dim=1):
        replay.extend(rollout)
    return replay


LENGTHS = [[5, 1, 9, 3, 40], [12, 2, 2, 30, 40], [50, 1]]
DRAWS = {
    "episodes": lambda replay, n, g: replay.episodes(n, g),
    "windows": lambda replay, n, g: replay.windows(n, 6, g),
    "windows after a burn-in": lambda replay, n, g: replay.windows(n, 6, g, burn_in=3),
    "sequences": lambda replay, n, g: replay.sequences(n, 6, 2, g, burn_in=3),
}


@pytest.mark.parametrize("capacity", [10_000, 3 * 24])
@pytest.mark.parametrize("draw", DRAWS)
def test_what_is_drawn_is_consecutive_steps_of_one_episode(draw, capacity):
    """Also where the ring has been overwritten."""
    batch = DRAWS[draw](filled([[5, 1, 9, 3, 30], [12, 2, 2, 32], [9] * 6], 48, capacity), 200, generator())
    for piece in batch:
        seen = piece["observation"][piece["mask"]]
        assert len(seen) > 0
        assert (seen[:, :2] == seen[0, :2]).all()
        assert torch.equal(seen[:, 2], seen[0, 2] + torch.arange(len(seen)))
        assert torch.equal(piece["next", "observation"][piece["mask"]][:, 2], seen[:, 2] + 1)
        assert not piece["mask"][len(seen) :].any()
        assert torch.equal(piece["is_init"][piece["mask"]][:, 0], seen[:, 2] == 0)


@pytest.mark.parametrize("draw", DRAWS)
def test_states_are_those_that_were_recorded(draw):
    recorded = stream(LENGTHS, 48)
    state_of = {
        tuple(x): s
        for x, s in zip(
            recorded["observation"].flatten(0, 1).tolist(),
            recorded["recurrent_state"].flatten(0, 1).tolist(),
            strict=True,
        )
    }
    batch = DRAWS[draw](filled(LENGTHS, 48), 50, generator())
    for piece in batch:
        for x, s in zip(piece["observation"].tolist(), piece["recurrent_state"].tolist(), strict=True):
            assert state_of[tuple(x)] == s


def test_episodes_are_whole_and_equally_likely():
    replay = filled(LENGTHS, 48)
    assert replay.n_episodes == 5 + 5 + 1
    assert len(replay) == 3 * 48
    batch = replay.episodes(4000, generator())
    assert (batch["observation"][:, 0, 2] == 0).all()
    drawn = batch["observation"][:, 0, :2].long()
    # cut where the recording ends
    lengths = torch.tensor([[5, 1, 9, 3, 30], [12, 2, 2, 30, 2], [48, 0, 0, 0, 0]])
    assert torch.equal(batch["mask"].sum(1), lengths[drawn[:, 0], drawn[:, 1]])
    counts = torch.bincount(5 * drawn[:, 0] + drawn[:, 1])
    assert chisquare(counts[counts > 0].numpy()).pvalue > LEAST_P
    assert (counts > 0).sum() == 11


def test_windows_begin_at_every_step_of_every_episode_alike():
    batch = filled([[20, 3], [1, 22]], 23).windows(8000, 6, generator())
    copy, episode, start = batch["observation"][:, 0].long().T
    counts = torch.bincount(100 * copy + 50 * episode + start)
    assert chisquare(counts[counts > 0].numpy()).pvalue > LEAST_P
    assert (counts > 0).sum() == 2 * 23
    lengths = torch.tensor([[20, 3], [1, 22]])[copy, episode]
    assert torch.equal(batch["mask"].sum(1), (lengths - start).clamp(max=6))


def test_windows_have_their_burn_in_in_front_as_far_as_the_episode_has_it():
    batch = filled([[20]], 20).windows(8000, 6, generator(), burn_in=3)
    first = batch["observation"][:, 0, 2].long()
    lengths = batch["mask"].sum(1)
    begun_before = first > 0
    assert (lengths[begun_before] > 3).all()  # something is left after the burn-in
    learned = torch.bincount(first[begun_before] + 3, minlength=20)
    assert (learned[:4] == 0).all()
    assert chisquare(learned[4:].numpy()).pvalue > LEAST_P
    # those at the episode's start are from starts at 0, 1, 2 and 3
    assert abs(float((~begun_before).float().mean()) - 4 / 20) < 4 * (0.2 * 0.8 / 8000) ** 0.5


def test_sequences_begin_every_stride_and_are_equally_likely():
    batch = filled([[20, 3, 8]], 31).sequences(8000, 6, 4, generator(), burn_in=2)
    episode, start = batch["observation"][:, 0, 1].long(), batch["observation"][:, 0, 2].long()
    counts = torch.bincount(20 * episode + start, minlength=60)
    expected = [0, 4, 8, 12, 16, 20, 40, 44]  # 17 would be the last with a step after the burn-in
    assert counts.nonzero()[:, 0].tolist() == expected
    assert chisquare(counts[expected].numpy()).pvalue > LEAST_P
    lengths = torch.tensor([20, 3, 8])[episode]
    assert torch.equal(batch["mask"].sum(1), (lengths - start).clamp(max=8))


def test_a_sequence_with_nothing_after_its_burn_in_is_not_drawn():
    batch = filled([[8, 5]], 13).sequences(500, 4, 2, generator(), burn_in=4)
    start = batch["observation"][:, 0, 2]
    lengths = batch["mask"].sum(1)
    assert ((lengths > 4) | (start == 0)).all()


def test_sequences_show_every_step_after_the_burn_in():
    """No step is in burn-ins alone, the strides being no longer than what is learned from."""
    batch = filled([[37]], 37).sequences(3000, 5, 5, generator(), burn_in=7)
    start = batch["observation"][:, :1, 2]
    step = torch.arange(batch.shape[1])
    counted = batch["mask"] & ((start == 0) | (step >= 7))
    assert set(batch["observation"][counted][:, 2].long().tolist()) == set(range(37))


def test_only_the_last_steps_are_kept():
    replay = filled([[6] * 20, [10] * 12, [5] * 20], 60, capacity=3 * 24)
    batch = replay.episodes(500, generator())
    drawn = {tuple(x) for x in batch["observation"][:, 0, :2].long().tolist()}
    # 24 steps of each copy, from step 36 on, where one episode begins; the others' began at 30 and at 35
    kept = {0: range(6, 10), 1: range(4, 6), 2: range(8, 12)}
    assert drawn == {(copy, episode) for copy, episodes in kept.items() for episode in episodes}
    assert len(replay) == 24 + 20 + 20


def test_an_episode_is_drawn_from_while_it_runs():
    replay = EpisodeReplay(100)
    first, second = stream([[40]], 20).split(10, dim=1)
    replay.extend(first)
    assert replay.episodes(1, generator())["mask"].sum() == 10
    replay.extend(second)
    assert replay.episodes(1, generator())["mask"].sum() == 20


@pytest.mark.parametrize("draw", DRAWS)
def test_the_same_seed_draws_the_same(draw):
    replay = filled(LENGTHS, 48)
    first, again = (DRAWS[draw](replay, 30, generator(3)) for _ in range(2))
    assert (first == again).all()
    other = DRAWS[draw](replay, 30, generator(4))
    assert not torch.equal(first["observation"][:, 0], other["observation"][:, 0])


def test_what_is_drawn_is_a_copy():
    replay = filled([[20]], 20)
    replay.episodes(1, generator())["observation"].zero_()
    assert replay.episodes(1, generator())["observation"][0, -1, 2] == 19


def test_errors_say_what_to_do():
    with pytest.raises(ValueError, match="at least 1 step, got 0"):
        EpisodeReplay(0)
    with pytest.raises(ValueError, match="call extend with a rollout first"):
        EpisodeReplay(10).episodes(1, generator())
    rollout = stream([[9], [9]], 8)
    with pytest.raises(
        ValueError, match=r"at most 5 steps of each, got 2 and 8; enlarge the capacity \(now 10\)"
    ):
        EpisodeReplay(10).extend(rollout)
    replay = EpisodeReplay(100)
    replay.extend(rollout)
    with pytest.raises(ValueError, match="rollouts of 2 copies"):
        replay.extend(rollout[:1])
    endless = filled([[60], [60]], 40, capacity=40)
    with pytest.raises(
        ValueError, match="none began within the last 20 steps of a copy; enlarge the capacity, now 40"
    ):
        endless.windows(1, 4, generator())
