"""The loss on a chain of two states with values in a table, by numbers worked out on paper; and its settings.

Q(0, .) = 1, 2     Q(1, .) = 3, 6     gamma = 1/2
in 0: action 1, reward 1, to 1        in 1: action 0, reward 1, to 0, where the episode is cut
"""

import pytest
import torch
from recurrent_cases import made_up_rollout, q_network
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")  # targets are set by hand here


class Table(nn.Module):
    """Q(x, .) for states 0 and 1."""

    def __init__(self):
        super().__init__()
        self.q = nn.Embedding.from_pretrained(torch.tensor([[1.0, 2.0], [3.0, 6.0]]).double(), freeze=False)

    def forward(self, observation):
        """(..., 1) -> (..., 2), which stand for hidden states too."""
        values = self.q(observation[..., 0])
        return values, values


def table(**names):
    keys = {"observation": "observation", "action_value": "action_value", "hidden": "hidden", **names}
    return TensorDictModule(
        Table(), in_keys=[keys["observation"]], out_keys=[keys["action_value"], keys["hidden"]]
    )


def chain(end="truncated", actions=(1, 0)):
    def column(*values, dtype=torch.float64):
        return torch.tensor([values], dtype=dtype)[..., None]

    over = column(False, True, dtype=torch.bool)
    after = {
        "observation": column(1, 0, dtype=torch.int64),
        "reward": column(1.0, 1.0),
        "terminated": over if end == "terminated" else ~over & False,
        "truncated": over if end == "truncated" else ~over & False,
        "done": over,
    }
    here = {
        "observation": column(0, 1, dtype=torch.int64),
        "action": torch.tensor([actions]),
        "is_init": column(True, False, dtype=torch.bool),
        "next": TensorDict(after, [1, 2]),
    }
    return TensorDict(here, [1, 2])


def of(answer):
    return answer["loss_value"].item()


CASES = {
    # Q(0,1) = 2 to 1 + Q(1,0)/2 = 2.5;  Q(1,0) = 3 to 1 + Q(0,1)/2 = 2, where the policy would go on with action 1
    "taken": (0.625, {"n_steps": 0}),
    # V(1) = 3/4 + 18/4 = 5.25, V(0) = 1/4 + 6/4 = 1.75: targets 3.625 and 1.875
    "expected": (1.953125, {"n_steps": 0, "bootstrap": "expected", "epsilon": 0.5}),
    # none was taken at the end: targets 2.5 and 1.875
    "taken, exploring": ((0.25 + 1.265625) / 2, {"n_steps": 0, "epsilon": 0.5}),
    # targets 1 + 6/2 = 4 and 2
    "max": (2.5, {"n_steps": 0, "bootstrap": "max"}),
    # G_1 = 2, G_0 = 1 + (3 + (2 - 3)/2) / 2 = 2.25
    "lambda": (0.53125, {"weights": 0.5}),
    # of two steps 1 + 1/2 + 2/4 = 2, hit; the second has one step only: (0.25/2 + 0 + 1) / 2
    "sum": (0.5625, {"n_steps": 1, "weights": [1.0, 1.0]}),
    "sum, 3 to 1": ((0.75 * 0.25 + 1.0) / 2, {"n_steps": 1, "weights": [3.0, 1.0]}),
    # Q^pi(lambda): G_1 = 2, G_0 = 1 + (6 + (2 - 3)/2) / 2 = 3.75
    "expected, lambda": ((1.75**2 + 1.0) / 2, {"weights": 0.5, "bootstrap": "expected"}),
    # PQN's: G_0 = 1 + (6 + (2 - 6)/2) / 2 = 3
    "max, lambda": (1.0, {"weights": 0.5, "bootstrap": "max"}),
}


@pytest.mark.parametrize(("expected", "options"), CASES.values(), ids=CASES)
def test_the_loss_is_the_number_on_paper(expected, options):
    assert of(RecurrentSarsaLoss(table(), gamma=0.5, **options)(chain())) == expected  # binary fractions


def test_after_a_termination_there_is_no_value():
    """(2 - 2.5)^2 and (3 - 1)^2."""
    assert of(RecurrentSarsaLoss(table(), gamma=0.5, n_steps=0)(chain("terminated"))) == 2.125


def test_the_averaged_network_values_the_best_action_of_the_network():
    """Action 1 in both states, which the averaged network has at 10 and 4: targets 3 and 6."""
    loss = RecurrentSarsaLoss(table(), gamma=0.5, n_steps=0, bootstrap="double", delay_value=True)
    loss.target_value_network_params["module", "q", "weight"].data.copy_(
        torch.tensor([[12.0, 10.0], [7.0, 4.0]])
    )
    assert of(loss(chain())) == (1.0 + 9.0) / 2


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("semi", [[0.0, -0.5], [1.0, 0.0]]),  # the differences themselves: 2 - 2.5 and 3 - 2
        (
            "residual",
            [[0.0, -0.5 - 0.5], [1.0 + 0.25, 0.0]],
        ),  # less gamma times each at what was bootstrapped from
    ],
)
def test_semi_and_residual_are_one_value_and_two_gradients(kind, expected):
    network = table()
    answer = RecurrentSarsaLoss(network, gamma=0.5, n_steps=0, gradient=kind)(chain())
    answer["loss_value"].backward()
    assert of(answer) == CASES["taken"][0]
    assert network.module.q.weight.grad.tolist() == expected


@pytest.mark.parametrize("form", ["categorical", "categorical column", "one-hot"])
@pytest.mark.parametrize("actions", [(1, 0), (0, 1), (1, 1)])
def test_actions_may_be_numbers_or_one_hot(form, actions):
    loss = RecurrentSarsaLoss(table(), gamma=0.5, weights=0.3)
    rollout = chain(actions=actions)
    expected = of(loss(rollout.clone()))
    if form == "categorical column":
        rollout["action"] = rollout["action"][..., None]
    elif form == "one-hot":
        rollout["action"] = nn.functional.one_hot(rollout["action"], 2)
    assert of(loss(rollout)) == expected


def test_keys_may_have_other_names():
    names = {
        "action": "choice",
        "action_value": "q",
        "hidden": ("inner", "h"),
        "reward": "pay",
        "terminated": "dead",
        "is_init": "begins",
        "observation": "x",
        "mask": "there",
        "action_probability": "mu",
    }
    options = {"gamma": 0.5, "bootstrap": "expected", "importance": True, "temperature": 1.0}
    rollout = (
        chain()
        .set("mask", torch.tensor([[True, True]]))
        .set("action_probability", torch.tensor([[0.9, 0.7]]))
    )
    network = table(observation="x", action_value="q", hidden=("inner", "h"))
    loss = RecurrentSarsaLoss(network, **options)
    loss.set_keys(**names)
    renamed, there = rollout.clone(), set(rollout.keys(True))
    for old, new in names.items():
        if old in there:
            renamed.rename_key_(old, new)
        if ("next", old) in there:
            renamed.rename_key_(("next", old), ("next", new))
    assert of(loss(renamed)) == of(RecurrentSarsaLoss(table(), **options)(rollout))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gamma": 1.5}, "gamma from 0 to 1, got 1.5"),
        ({"bootstrap": "best"}, """expected bootstrap "taken", .* got 'best' and 'semi'"""),
        ({"gradient": "full"}, "expected .* gradient .* got 'taken' and 'full'"),
        ({"weights": [0.5, 0.5]}, "weights of your own need n_steps"),
        ({"weights": [0.5, 0.5], "n_steps": 2}, "3 weights of at least 0"),
        ({"gradient": "residual", "delay_value": True}, "take delay_value=False"),
        ({"bootstrap": "double"}, "needs the target parameters of delay_value=True"),
        ({"importance": True}, 'take bootstrap="expected"'),
        ({"importance": True, "bootstrap": "expected", "n_steps": 1}, "n_steps=None"),
        ({"importance": True, "bootstrap": "expected", "gradient": "residual"}, 'gradient="semi"'),
        ({"munchausen": 0.9}, """above 0 with bootstrap="expected" .* got 0.9 with 'taken'"""),
        ({"munchausen": 0.9, "bootstrap": "expected", "gradient": "residual"}, "'residual'"),
        ({"munchausen": 1.0, "bootstrap": "expected"}, "from 0 to below 1"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RecurrentSarsaLoss(table(), **options)


def test_a_batch_that_is_not_of_rollouts_is_refused():
    with pytest.raises(
        ValueError, match=r"expected a batch \(n, n_steps\) of rollouts, got batch size \(2,\)"
    ):
        RecurrentSarsaLoss(table())(chain()[0])


@pytest.mark.parametrize("shape", [(1, 2), (1, 2, 1)])
def test_a_batch_of_nothing_but_padding_is_refused(shape):
    rollout = chain().set("there", torch.zeros(shape, dtype=torch.bool))
    loss = RecurrentSarsaLoss(table())
    loss.set_keys(mask="there")
    with pytest.raises(
        ValueError, match=r"at least one step .* got 'there' False at all of \(1, 2\) steps: leave"
    ):
        loss(rollout)


def test_importance_needs_the_probabilities():
    loss = RecurrentSarsaLoss(q_network(), importance=True, bootstrap="expected")
    with pytest.raises(ValueError, match="need the probability of each action .* 'action_probability'"):
        loss(made_up_rollout().exclude("action_probability"))
