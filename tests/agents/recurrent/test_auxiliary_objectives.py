"""What hidden states are asked to predict, against loops over steps and numpy's moments.

Double precision: TOLD is some roundings of sums of a few dozen terms of unit size, taken in another order.
"""

import numpy as np
import pytest
import torch
from torch import nn
from torch.testing import assert_close

from beliefgym.agents.recurrent.auxiliary import OBJECTIVES, Pieces, futures, make_auxiliary

TOLD = {"rtol": 1e-10, "atol": 1e-11}
LENGTHS = (4, 1, 6, 6, 2)
N, T, H, X, A = len(LENGTHS), max(LENGTHS), 7, 2, 3
OPTIONS = {
    "dynamics": {},
    "predictive_state": {"k": 3},
    "predictive_rewards": {"k": 4},
    "predictive_values": {"k": 2},
    "latent_self_prediction": {},
}
STATISTICS = ("predictive_state", "predictive_rewards", "predictive_values")


def made_up_pieces(seed=0, lengths=LENGTHS, rubbish=0.0):
    """What stands past the end of pieces is noise, and rubbish besides."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    mask = torch.arange(T) < torch.tensor(lengths)[:, None]
    slots = torch.cat([mask.new_ones(N, 1), mask], dim=1)[..., None]
    returns = 3.0 + draw(N, T)
    return Pieces(
        hidden=torch.where(slots, 0.4 * draw(N, T + 1, H), rubbish),
        target_hidden=torch.where(slots, 0.4 * draw(N, T + 1, H), rubbish),
        observation=torch.where(slots, draw(N, T + 1, X), rubbish),
        actions=torch.where(
            mask[..., None], nn.functional.one_hot(torch.randint(A, (N, T), generator=generator)), 0.0
        ),
        rewards=torch.where(mask, -2.0 + 0.5 * draw(N, T), rubbish),
        returns=lambda: torch.where(mask, returns, rubbish),
        mask=mask,
    )


def targets_by_loop(name, pieces, k):
    """(piece, step) -> what is to be predicted there, nan where it does not exist."""
    found = {}
    for i, length in enumerate(pieces.mask.sum(1).tolist()):
        for t in range(length):
            if name == "predictive_state":
                rows = [pieces.observation[i, t + 1 + j] for j in range(k) if t + j < length]
            elif name == "dynamics":
                rows = [pieces.observation[i, t + 1]]
            else:
                x = pieces.rewards if name == "predictive_rewards" else pieces.returns()
                rows = [x[i, t + j][None] for j in range(k) if t + j < length]
            row = torch.cat(rows)
            missing = k * len(rows[0]) - len(row)
            found[i, t] = torch.cat([row, torch.full((missing,), torch.nan, dtype=row.dtype)])
    return found


def objective_of(name, seed=0, **more):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return make_auxiliary(name, H, X, A, **{**OPTIONS[name], **more}).double()


@pytest.mark.parametrize("k", [1, 2, 9])
def test_futures_are_the_next_of_a_sequence(k):
    pieces = made_up_pieces()
    x = pieces.observation[:, 1:]
    found, exists = futures(x, k, pieces.mask)
    assert found.shape == exists.shape == (N, T, k * X)
    for i, length in enumerate(LENGTHS):
        for t in range(T):
            for j in range(k):
                there = t + j < length
                at = slice(j * X, (j + 1) * X)
                assert exists[i, t, at].tolist() == [there] * X
                if there:
                    assert torch.equal(found[i, t, at], x[i, t + j])


@pytest.mark.parametrize("name", ["dynamics", *STATISTICS])
def test_targets_are_those_of_a_loop(name):
    objective, pieces = objective_of(name), made_up_pieces()
    found, exists = objective.targets(pieces)
    found = torch.where(exists, found, torch.nan)
    expected = targets_by_loop(name, pieces, OPTIONS[name].get("k", 1))
    for i in range(N):
        for t in range(T):
            at = expected.get((i, t), torch.full_like(found[i, t], torch.nan))
            assert_close(found[i, t], at, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("on_hidden", [False, True])
@pytest.mark.parametrize("name", STATISTICS)
def test_the_error_is_the_mean_over_all_predictions_that_exist(name, on_hidden):
    """Of the decoder, or of the first entries of h, three deviations wide."""
    objective, pieces = objective_of(name, on_hidden=on_hidden), made_up_pieces()
    objective.eval()
    size = objective.target_size
    objective.mean.copy_(torch.linspace(-1.0, 1.0, size))
    objective.std.copy_(torch.linspace(0.5, 2.0, size))
    errors = []
    for (i, t), target in targets_by_loop(name, pieces, OPTIONS[name]["k"]).items():
        h = pieces.hidden[i, t]
        predicted = 3.0 * h[:size] if on_hidden else objective.decoder(h)
        errors += (predicted - (target - objective.mean) / objective.std).square().tolist()
    assert objective(pieces).item() == pytest.approx(np.nanmean(errors), rel=1e-10)
    assert not objective.count.any()  # nothing is learned in evaluation


@pytest.mark.parametrize("name", ["dynamics", "latent_self_prediction"])
def test_transitions_go_from_a_state_and_an_action_to_what_follows(name):
    objective, pieces = objective_of(name).eval(), made_up_pieces()
    errors = []
    for i, length in enumerate(LENGTHS):
        for t in range(length):
            following = objective.transition(torch.cat([pieces.hidden[i, t], pieces.actions[i, t]]))
            if name == "dynamics":
                error = objective.decoder(following) - pieces.observation[i, t + 1]
            else:
                error = following - pieces.target_hidden[i, t + 1]
            errors.append(error.square().mean().item())
    assert objective(pieces).item() == pytest.approx(np.mean(errors), rel=1e-10)


@pytest.mark.parametrize("name", OPTIONS)
def test_what_lies_past_the_end_of_pieces_never_matters(name):
    objectives = [objective_of(name) for _ in range(2)]
    values = [o(made_up_pieces(rubbish=r)) for o, r in zip(objectives, (0.0, 1e3), strict=True)]
    assert_close(values[0], values[1], rtol=0, atol=0)
    for first, second in zip(*(o.buffers() for o in objectives), strict=True):
        assert torch.equal(first, second)


@pytest.mark.parametrize("name", ["dynamics", *STATISTICS])
def test_moments_are_those_of_all_batches_so_far(name):
    """Batches of one size, so that numpy's over everything are the same."""
    objective = objective_of(name)
    rows = []
    for seed in range(6):
        pieces = made_up_pieces(seed)
        objective(pieces)
        rows += [x.numpy() for x in targets_by_loop(name, pieces, OPTIONS[name].get("k", 1)).values()]
        np.testing.assert_allclose(objective.mean, np.nanmean(rows, 0), rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(objective.std, np.nanstd(rows, 0), rtol=1e-10)


def test_after_a_hundred_batches_a_batch_weighs_one_in_a_hundred():
    objective = objective_of("predictive_rewards", k=1)
    for seed in range(100):
        objective(made_up_pieces(seed))
    mean, variance = float(objective.mean), float(objective.std) ** 2
    for seed in (200, 201):
        pieces = made_up_pieces(seed)
        new = pieces.rewards[pieces.mask]
        objective(pieces)
        expected = 0.99 * mean + 0.01 * new.mean().item()
        assert float(objective.mean) == pytest.approx(expected, rel=1e-10)
        # of the mixture 0.99 to 0.01: second moments mix
        second = 0.99 * (variance + mean**2) + 0.01 * new.square().mean().item()
        mean, variance = expected, second - expected**2
        assert float(objective.std) ** 2 == pytest.approx(variance, rel=1e-9)


@pytest.mark.parametrize("name", STATISTICS)
def test_batches_that_lack_a_target_leave_its_moments_alone(name):
    """Pieces of one step tell nothing of what comes later."""
    objective = objective_of(name)
    short = (1,) * N
    objective(made_up_pieces(0))
    per_step = objective.target_size // objective.k
    before = [objective.mean[per_step:].clone(), objective.std[per_step:].clone()]
    for seed in range(1, 6):
        objective(made_up_pieces(seed, lengths=short))
    assert_close(objective.mean[per_step:], before[0], **TOLD)
    assert_close(objective.std[per_step:], before[1], **TOLD)
    assert (objective.std[:per_step] != 1.0).all()


@pytest.mark.parametrize("name", STATISTICS)
def test_the_first_moments_of_a_target_do_not_depend_on_batches_that_lack_it(name):
    objectives = [objective_of(name) for _ in range(2)]
    objectives[0](made_up_pieces(1, lengths=(1,) * N))
    for objective in objectives:
        objective(made_up_pieces(0))
    per_step = objectives[0].target_size // objectives[0].k
    assert_close(objectives[0].mean[per_step:], objectives[1].mean[per_step:], **TOLD)
    assert_close(objectives[0].std[per_step:], objectives[1].std[per_step:], **TOLD)


def test_a_constant_target_is_no_division_by_zero():
    pieces = made_up_pieces()
    pieces.rewards.fill_(1.0)
    objective = objective_of("predictive_rewards", on_hidden=True, k=1)
    expected = (3.0 * pieces.hidden[:, :-1, :1][pieces.mask]).square().mean()
    assert_close(objective(pieces), expected, **TOLD)


@pytest.mark.parametrize("name", STATISTICS)
def test_a_hidden_state_too_small_for_the_prediction_is_refused(name):
    size = 8 * (X if name == "predictive_state" else 1)
    message = (
        f"hidden state of at least {size} to hold the prediction of '{name}' itself, got 7; take a larger"
    )
    with pytest.raises(ValueError, match=message):
        make_auxiliary(name, H, X, A, k=8, on_hidden=True)
    make_auxiliary(name, H, X, A, k=8)  # a decoder takes any
    make_auxiliary(name, H, X, A, k=3, on_hidden=True)


def test_objectives_go_by_their_names():
    assert set(OBJECTIVES) == set(OPTIONS)
    for name in OPTIONS:
        assert objective_of(name).name == name
    with pytest.raises(ValueError, match="objective out of dynamics, .*, got 'curiosity'"):
        make_auxiliary("curiosity", H, X, A)
