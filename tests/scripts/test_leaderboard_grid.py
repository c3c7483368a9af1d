"""The grid: what decides a cell's identity, and what is refused."""

import dataclasses
import json

import pytest
from fake_cells import FakeTask, make_grid

from beliefgym.scripts.leaderboard.errors import NotPlainJSONError
from beliefgym.scripts.leaderboard.grid import AgentVariant, Cell, Grid, plain_json, product, slug

CELL = Cell(
    task={
        "env_id": "beliefgym/PendulumPosition-v0",
        "kwargs": {"g": 10.0},
        "wrappers": [("Delay", {"steps": 2})],
    },
    task_label="PendulumPosition-v0",
    agent="sac-stack",
    agent_options={"policy": {"net_arch": (64, 64)}},
    seed=0,
    total_timesteps=30_000,
    eval_episodes=100,
)


def test_a_cell_survives_json_with_the_same_hash() -> None:
    again = Cell.from_dict(json.loads(json.dumps(CELL.to_dict())))
    assert again == CELL
    assert again.config_hash == CELL.config_hash


def test_the_key_names_task_agent_and_seed() -> None:
    assert CELL.key == "PendulumPosition-v0/sac-stack/seed-0"
    assert dataclasses.replace(CELL, task_label="beliefgym/A (x=1)", agent_label="my:agent").key == (
        "beliefgym-A-x-1/my-agent/seed-0"
    )


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 1},
        {"total_timesteps": 1},
        {"eval_episodes": 1},
        {"eval_seed": 1},
        {"curve_points": 1},
        {"curve_episodes": 1},
        {"agent": "sac"},
        {"agent_options": {"policy": {"net_arch": [64, 65]}}},
        {"task": {"env_id": "beliefgym/PendulumPosition-v0"}},
    ],
)
def test_whatever_decides_the_result_changes_the_hash(change: dict) -> None:
    assert dataclasses.replace(CELL, **change).config_hash != CELL.config_hash


def test_labels_and_the_order_of_options_do_not_change_the_hash() -> None:
    task = {
        "wrappers": [["Delay", {"steps": 2}]],
        "kwargs": {"g": 10.0},
        "env_id": "beliefgym/PendulumPosition-v0",
    }
    other = dataclasses.replace(CELL, task=task, task_label="another", agent_label="another")
    assert other.config_hash == CELL.config_hash


def test_the_hash_is_the_same_on_every_machine_and_day() -> None:
    # Pinned: a change of this value would make every record on disk look outdated.
    assert CELL.config_hash == "68b182d901a7fd9d"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, "seed of a cell is a whole number of at least 0, not -1"),
        ({"eval_episodes": 0}, "eval_episodes of a cell is a whole number of at least 1"),
        ({"total_timesteps": 1e4}, "total_timesteps of a cell is a whole number"),
        ({"task_label": " / "}, "a label needs at least one letter or digit"),
        ({"agent_options": {"lr": float("inf")}}, r"agent_options\.lr is inf, not a finite number"),
        (
            {"agent_options": {"net": [1, object()]}},
            r"agent_options\.net\[1\] is a builtins\.object, which is not",
        ),
        ({"task": {1: 2}}, "task has the key 1; keys are text"),
    ],
)
def test_bad_cells_are_refused_by_the_field(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(CELL, **change)


def test_unknown_and_missing_fields_are_named() -> None:
    with pytest.raises(ValueError, match="a cell has no field colour"):
        Cell.from_dict({**CELL.to_dict(), "colour": 1})
    with pytest.raises(ValueError, match=r"a cell lacks a field.*'seed'"):
        Cell.from_dict({name: value for name, value in CELL.to_dict().items() if name != "seed"})


def test_product_runs_the_first_seed_of_everything_first() -> None:
    cells = product(
        [FakeTask("a"), FakeTask("b")],
        [
            "sac",
            AgentVariant("random", total_timesteps=0),
            AgentVariant("sac", {"lr": 1.0}, label="sac-fast"),
        ],
        [7, 8],
        total_timesteps=10,
        eval_episodes=3,
    )
    assert [cell.key for cell in cells[:7]] == [
        *("a/sac/seed-7", "a/random/seed-7", "a/sac-fast/seed-7"),
        *("b/sac/seed-7", "b/random/seed-7", "b/sac-fast/seed-7", "a/sac/seed-8"),
    ]
    assert [cell.total_timesteps for cell in cells[:3]] == [10, 0, 10]
    assert [dict(cell.agent_options) for cell in cells[:3]] == [{}, {}, {"lr": 1.0}]
    assert len(cells) == 12


def test_a_grid_lists_tasks_and_agents_in_order_of_appearance() -> None:
    grid = make_grid(("weak", "strong"), tasks=("z", "a"))
    assert grid.tasks == ("z", "a")
    assert grid.agents == ("weak", "strong")


def test_a_grid_refuses_cells_that_would_share_a_record() -> None:
    # Case alone does not tell files apart on every system.
    cells = (CELL, dataclasses.replace(CELL, agent_label="SAC-stack", total_timesteps=1))
    with pytest.raises(
        ValueError, match=r"would share the record PendulumPosition-v0/SAC-stack/seed-0.*agent_label"
    ):
        Grid("standard", cells, 60.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("standard", (), 60.0), "has no cells"),
        (("a/b", (CELL,), 60.0), "part of file names: 'a-b' would do"),
        (("standard", (CELL,), 0.0), "time_limit_s is a number of seconds above 0"),
    ],
)
def test_bad_grids_are_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Grid(*arguments)


def test_plain_json_names_the_part_that_is_not() -> None:
    assert plain_json({"a": (1, 2.5, None, True, "x")}, "it") == {"a": [1, 2.5, None, True, "x"]}
    with pytest.raises(NotPlainJSONError, match=r"it\.a\[1\]\.b is nan"):
        plain_json({"a": [0, {"b": float("nan")}]}, "it")


def test_a_slug_cannot_leave_its_folder() -> None:
    assert slug("../../etc/passwd") == "etc-passwd"
