"""The network step by step, along rows, and along single episodes; its memories against PyTorch's cells.

Double precision: TOLD is a few roundings of numbers of unit size, in sums that PyTorch takes in another order.
"""

import pytest
import torch
from recurrent_cases import STATE_SIZES, made_up_rollout, pieces_by_loop, q_network, values_along
from torch import nn
from torchrl.modules import set_recurrent_mode

from beliefgym.agents.recurrent.memory import GRU, LSTM, Memory, NoMemory, Stack, make_memory
from beliefgym.agents.recurrent.network import DuellingHead

TOLD = {"rtol": 1e-11, "atol": 1e-12}
each_cell = pytest.mark.parametrize("cell", STATE_SIZES)


def rolled(network, rollout):
    """Q, h and the last states of whole rows."""
    with set_recurrent_mode(True), torch.no_grad():
        answer = network(rollout.clone())
    return answer["action_value"], answer["hidden"], answer["next", "recurrent_state"]


@each_cell
@pytest.mark.parametrize("p_end", [0.0, 0.3, 1.0])
def test_rows_are_their_episodes_each_from_its_own_start(cell, p_end):
    network = q_network(cell, rewards=True)
    rollout = made_up_rollout(state_size=STATE_SIZES[cell], p_end=p_end)
    values, hidden, _ = rolled(network, rollout)
    for row, begin, end in pieces_by_loop(rollout["is_init"][..., 0]):
        with torch.no_grad():
            q, h = values_along(network, rollout, (row, begin, end))
        torch.testing.assert_close(values[row, begin:end], q[:-1], **TOLD)
        torch.testing.assert_close(hidden[row, begin:end], h[:-1], **TOLD)


def stepped(network, rollout):
    """The same, one step at a time."""
    state, values, hidden = rollout["recurrent_state"][:, 0], [], []
    for t in range(rollout.shape[1]):
        with torch.no_grad():
            step = network(rollout[:, t].clone().set("recurrent_state", state))
        state = step["next", "recurrent_state"]
        values.append(step["action_value"])
        hidden.append(step["hidden"])
    return torch.stack(values, 1), torch.stack(hidden, 1), state


@each_cell
@pytest.mark.parametrize("p_end", [0.0, 0.3])
def test_step_by_step_is_as_along_rows(cell, p_end):
    network = q_network(cell, rewards=True)
    rollout = made_up_rollout(state_size=STATE_SIZES[cell], p_end=p_end)
    for along, by_step in zip(rolled(network, rollout)[:2], stepped(network, rollout)[:2], strict=True):
        torch.testing.assert_close(along, by_step, **TOLD)


@pytest.mark.parametrize("cell", ["lstm", "gru", "stack4"])
@pytest.mark.parametrize("p_end", [0.0, 0.3, 1.0])
def test_the_state_told_along_a_row_is_the_one_after_its_last_step(cell, p_end):
    network = q_network(cell)
    rollout = made_up_rollout(state_size=STATE_SIZES[cell], p_end=p_end)
    after, expected = rolled(network, rollout)[2], stepped(network, rollout)[2]
    torch.testing.assert_close(after, expected[:, None].expand_as(after), **TOLD)


@pytest.mark.parametrize("cell", ["lstm", "gru", "stack4"])
def test_what_came_before_an_episode_changes_nothing_in_it(cell):
    network = q_network(cell, rewards=True)
    rollout = made_up_rollout(state_size=STATE_SIZES[cell])
    values, *_ = rolled(network, rollout)
    changed = rollout.clone()
    is_init = rollout["is_init"][..., 0]
    first = [next((t for t, begins in enumerate(row) if begins and t > 0), None) for row in is_init.tolist()]
    assert any(t is not None for t in first)
    for row, t in enumerate(first):
        for key in ("observation", "previous_action", "previous_reward", "recurrent_state"):
            changed[key][row, : 7 if t is None else t] += 1.0
    other, *_ = rolled(network, changed)
    for row, t in enumerate(first):
        if t is not None:
            assert torch.equal(other[row, t:], values[row, t:])
            assert (other[row, :t] - values[row, :t]).abs().max() > 1e-3


@pytest.mark.parametrize("cell", ["lstm", "gru", "stack4"])
def test_the_state_before_counts_inside_an_episode_and_not_at_its_start(cell):
    network = q_network(cell)
    rollout = made_up_rollout(state_size=STATE_SIZES[cell])
    values, *_ = rolled(network, rollout)
    changed = rollout.clone()
    changed["recurrent_state"] += 1.0
    other, *_ = rolled(network, changed)
    begins = rollout["is_init"][:, 0, 0]
    assert torch.equal(other[begins], values[begins])
    moved = (other - values).abs().flatten(1).max(1).values
    assert (moved[~begins] > 1e-3).all()


@pytest.mark.parametrize(
    ("key", "option", "used"),
    [
        ("observation", {}, True),
        ("previous_action", {}, True),
        ("previous_action", {"previous_actions": False}, False),
        ("previous_reward", {}, False),
        ("previous_reward", {"rewards": True}, True),
    ],
)
def test_the_network_sees_what_it_is_told_to_see(key, option, used):
    network = q_network("gru", **option)
    rollout = made_up_rollout(state_size=5)
    values, *_ = rolled(network, rollout)
    rollout[key] += 1.0
    moved = (rolled(network, rollout)[0] - values).abs().max()
    assert moved > 1e-3 if used else moved == 0.0


def test_observations_are_standardised_and_clamped():
    encoder = q_network().encoder
    x = torch.tensor([[0.5, -2.0, 1e6]], dtype=torch.float64)
    expected = (x - encoder.mean) / encoder.scale
    expected[0, 2] = 10.0
    assert torch.equal(encoder.standardised(x), expected)
    assert (encoder.standardised(-1e6 * torch.ones_like(x)) == -10.0).all()


def test_values_are_their_mean_and_advantages_without_one():
    head = DuellingHead(5, 3, 6).double()
    hidden = torch.randn(4, 2, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    values, raw = head(hidden), head.layers(hidden)
    torch.testing.assert_close(values.mean(-1), raw[..., 0], **TOLD)
    torch.testing.assert_close(values.diff(dim=-1), raw[..., 1:].diff(dim=-1), **TOLD)


@pytest.mark.parametrize("kind", [LSTM, GRU])
def test_a_memory_is_pytorchs_cell_in_a_loop(kind):
    memory = kind(3, 4).double()
    cell = (nn.LSTMCell if kind is LSTM else nn.GRUCell)(3, 4).double()
    cell.load_state_dict({key.removesuffix("_l0"): value for key, value in memory.layer.state_dict().items()})
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(2, 6, 3, dtype=torch.float64, generator=generator)
    state = torch.randn(2, memory.state_size, dtype=torch.float64, generator=generator)
    hidden, after = memory(inputs, state)
    parts = state.split(4, dim=1)
    for t in range(6):
        parts = cell(inputs[:, t], parts) if kind is LSTM else (cell(inputs[:, t], parts[0]),)
        torch.testing.assert_close(hidden[:, t], parts[0], **TOLD)
    torch.testing.assert_close(after, torch.cat(parts, dim=1), **TOLD)


@pytest.mark.parametrize("n_frames", [2, 4])
def test_a_stack_is_one_layer_on_the_last_inputs(n_frames):
    memory = Stack(3, 5, n_frames).double()
    generator = torch.Generator().manual_seed(0)
    inputs, before = torch.randn(2, 2, 6, 3, dtype=torch.float64, generator=generator)
    state = before[:, 6 - (n_frames - 1) :].flatten(1)
    hidden, after = memory(inputs, state)
    frames = torch.cat([before, inputs], dim=1)
    for t in range(6):
        last = frames[:, 6 + t - n_frames + 1 : 6 + t + 1].flatten(1)
        torch.testing.assert_close(hidden[:, t], memory.layer.layer(last), **TOLD)
    assert torch.equal(after, inputs[:, 6 - (n_frames - 1) :].flatten(1))
    with pytest.raises(ValueError, match="at least 2 frames, got 1"):
        Stack(3, 5, 1)


class Sum(Memory):
    """A memory of one's own: h is the sum of inputs."""

    def __init__(self, input_size, hidden_size):
        super().__init__(input_size, hidden_size, input_size)
        self.out = nn.Linear(input_size, hidden_size)

    def forward(self, inputs, state):
        """See `Memory.forward`."""
        sums = state[:, None] + inputs.cumsum(1)
        return self.out(sums), sums[:, -1]


def test_a_memory_of_ones_own_takes_part():
    network = q_network(Sum)
    assert network.state_size == 6
    rollout = made_up_rollout(state_size=6)
    values, *_ = rolled(network, rollout)
    piece = pieces_by_loop(rollout["is_init"][..., 0])[0]
    with torch.no_grad():
        q, _ = values_along(network, rollout, piece)
    torch.testing.assert_close(values[piece[0], piece[1] : piece[2]], q[:-1], **TOLD)


def test_memories_have_names_and_others_are_refused():
    kinds = {"lstm": LSTM, "gru": GRU, "none": NoMemory, "stack2": Stack, "stack4": Stack}
    for name, kind in kinds.items():
        memory = make_memory(name, 6, 5)
        assert type(memory) is kind
        assert (memory.input_size, memory.hidden_size, memory.state_size) == (6, 5, STATE_SIZES[name])
    with pytest.raises(ValueError, match="expected cell to be one of lstm, gru, none, .* got 'rnn'"):
        make_memory("rnn", 2, 3)
    with pytest.raises(TypeError, match="a cell as a name or a subclass of Memory"):
        make_memory(nn.Linear, 2, 3)
