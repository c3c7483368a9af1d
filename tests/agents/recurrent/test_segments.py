"""Pieces of rows against a loop over steps."""

import numpy as np
import pytest
import torch
from recurrent_cases import pieces_by_loop

from beliefgym.agents.recurrent.segments import Segments


def cases():
    rng = np.random.default_rng(0)
    for n, n_steps, p in [(1, 1, 0.5), (1, 6, 0.0), (4, 9, 0.3), (3, 5, 1.0), (6, 20, 0.1), (5, 1, 0.5)]:
        is_init = rng.random((n, n_steps)) < p
        yield pytest.param(is_init, None, id=f"{n}x{n_steps}, {p}")
        for kind in ("any", "whole row"):
            n_valid = rng.integers(1, n_steps + 1, size=n)
            if kind == "whole row":
                n_valid[0] = 0
                if n == 1:
                    continue
            valid = np.arange(n_steps) < n_valid[:, None]
            yield pytest.param(is_init, valid, id=f"{n}x{n_steps}, {p}, padded {kind}")


def numbered(n, n_steps):
    """A number for every step, and for what followed it, with one more axis."""
    x = torch.arange(n * n_steps, dtype=torch.float64).view(n, n_steps, 1) * torch.tensor([1.0, -1.0])
    return x, x + 0.5


each_case = pytest.mark.parametrize(("is_init", "valid"), list(cases()))


def segments(is_init, valid):
    return Segments(torch.from_numpy(is_init), None if valid is None else torch.from_numpy(valid))


@each_case
def test_pieces_lie_where_a_loop_cuts_them(is_init, valid):
    found, expected = segments(is_init, valid), pieces_by_loop(is_init, valid)
    assert len(found) == len(expected)
    assert found.rows.tolist() == [row for row, _, _ in expected]
    assert found.starts.tolist() == [begin for _, begin, _ in expected]
    assert found.lengths.tolist() == [end - begin for _, begin, end in expected]
    assert found.fresh.tolist() == [is_init[row, begin] for row, begin, _ in expected]


@each_case
def test_mask_and_last_steps_are_those_of_each_pieces_length(is_init, valid):
    found = segments(is_init, valid)
    lengths = [end - begin for _, begin, end in pieces_by_loop(is_init, valid)]
    assert found.mask.tolist() == [[t < n for t in range(max(lengths))] for n in lengths]
    assert found.is_last.tolist() == [[t == n - 1 for t in range(max(lengths))] for n in lengths]


@each_case
def test_steps_are_a_pieces_own_and_then_its_last(is_init, valid):
    x, _ = numbered(*is_init.shape)
    found = segments(is_init, valid).steps(x)
    for got, (row, begin, end) in zip(found, pieces_by_loop(is_init, valid), strict=True):
        expected = [x[row, min(begin + t, end - 1)] for t in range(len(got))]
        assert torch.equal(got, torch.stack(expected))


@each_case
def test_slots_are_a_pieces_own_and_then_what_followed_its_last(is_init, valid):
    x, following = numbered(*is_init.shape)
    pieces = segments(is_init, valid)
    found = pieces.slots(x, following)
    assert found.shape[1] == pieces.mask.shape[1] + 1
    for got, (row, begin, end) in zip(found, pieces_by_loop(is_init, valid), strict=True):
        expected = [
            x[row, begin + t] if begin + t < end else following[row, end - 1] for t in range(len(got))
        ]
        assert torch.equal(got, torch.stack(expected))


@each_case
def test_back_undoes_steps(is_init, valid):
    x, _ = numbered(*is_init.shape)
    pieces = segments(is_init, valid)
    kept = x.flatten(0, 1) if valid is None else x[torch.from_numpy(valid)]
    assert torch.equal(pieces.back(pieces.steps(x)), kept)


def test_nothing_but_padding_has_no_pieces():
    pieces = Segments(torch.zeros(2, 3, dtype=torch.bool), torch.zeros(2, 3, dtype=torch.bool))
    assert len(pieces) == 0
    assert pieces.steps(torch.zeros(2, 3, 4)).numel() == 0


@pytest.mark.parametrize(
    ("is_init", "valid", "message"),
    [
        (torch.zeros(2, 3), None, r"expected is_init as bool \(n, n_steps\), got torch.float32 \(2, 3\)"),
        (torch.zeros(2, 3, 1).bool(), None, r"expected is_init as bool .*, got torch.bool \(2, 3, 1\)"),
        (torch.zeros(2, 3).bool(), torch.ones(2, 2).bool(), r"mask of shape \(2, 3\), got \(2, 2\)"),
        (torch.zeros(1, 3).bool(), torch.tensor([[False, True, True]]), "padding at the end of rows only"),
        (torch.zeros(1, 3).bool(), torch.tensor([[True, False, True]]), "padding at the end of rows only"),
    ],
)
def test_what_is_wrong_is_told(is_init, valid, message):
    with pytest.raises(ValueError, match=message):
        Segments(is_init, valid)
