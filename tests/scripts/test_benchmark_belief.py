"""The benchmark of beliefs steps and trains what it says, with and without them."""

import pytest

from beliefgym.scripts.benchmarks import belief as benchmark
from beliefgym.wrappers.task import Task

PENDULUM = "PendulumPosition-v0"


SMALL = {
    "COPIES": (2, 3),
    "NATIVE": (PENDULUM,),
    "MUJOCO": (),
    "UKF_MOST": 2,
    "TARGET_COPIES": 3,
    "N_EPISODES": 8,
    "N_ITERATIONS": 1,
    "WAVES": 10,
    "REPEATS": 1,
    "SECONDS": 0.001,
    "N_ENVS": 2,
    "N_STEPS": 8,
    "BATCH": 8,
    "EPOCHS": 1,
    "HIDDEN": 4,
    "ROLLOUTS": 1,
    "SAC_STEPS": 4,
    "TRAINING_SECONDS": 0.001,
}


@pytest.fixture(scope="module", autouse=True)
def small():
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SMALL.items():
            patch.setattr(benchmark, name, value)
        yield


@pytest.fixture(scope="module")
def filters():
    return benchmark.fitted(Task(PENDULUM))


def test_every_row_compares_with_and_without():
    told = []
    rows, limits = benchmark.run(told.append)
    assert told == [
        f"fitting filters of {PENDULUM}",
        f"{PENDULUM}, 2 copies",
        f"{PENDULUM}, 3 copies",
        "PPO and SAC from end to end",
    ]
    what = [row["what"] for row in rows]
    learned = [benchmark.LINEAR, benchmark.ACTIONS, benchmark.HINTS, benchmark.RANDOM]
    beside = [benchmark.HISTORY, benchmark.STACKED]
    two = [f"steps/s, {PENDULUM}, 2 copies: {name}" for name in (*learned, benchmark.UKF, *beside)]
    three = [f"steps/s, {PENDULUM}, 3 copies: {name}" for name in (*learned, *beside)]
    assert what[:13] == two + three
    assert [row["target"] for row in rows[:13]] == [None] * 7 + [0.7] * 4 + [None] * 2
    assert [row["rival_name"] for row in rows[7:13]] == ["without"] * 5 + ["SB3VecEnv without"]
    assert [(row["what"][:3], row["target"]) for row in rows[13:]] == [
        *([("PPO", 5.0), ("PPO", None)] * 2),
        *([("SAC", None)] * 2),
    ]
    for row in rows:
        assert row["ratio"] == pytest.approx(row["ours"]["value"] / row["rival"]["value"])
    microseconds = limits[f"microseconds a step of all, {PENDULUM}, 3 copies"]
    assert microseconds["without"] == pytest.approx(3e6 / rows[7]["rival"]["value"])
    taken = limits[f"an update, {PENDULUM}, 3 copies, {benchmark.RANDOM}"]["microseconds taken"]
    assert taken == pytest.approx(microseconds[benchmark.RANDOM] - microseconds["without"])


def test_filters_see_what_belief_policies_let_them_see(filters):
    assert [f.action_timing for f in filters.values()] == [
        "none",
        "present",
        "previous",
        "previous",
        "previous",
    ]
    assert filters[benchmark.RANDOM].n_hint_ == 3  # cosine, sine and speed, not the angle itself
    assert filters[benchmark.RANDOM].model_.n_frequencies == 10


def test_an_updates_work_is_that_of_its_products(filters):
    linear, waves = filters[benchmark.HINTS], filters[benchmark.RANDOM]
    size, inputs, m = 3 + 5 * 2, 3 + 5 * 2 + 2 + 1 + 1, 10
    assert linear.belief_size == waves.belief_size == size
    assert benchmark.work(linear, 4)["FLOPs"] == 2 * 4 * inputs * size
    assert benchmark.work(waves, 4)["FLOPs"] == 2 * 4 * (inputs * (m + size) + 2 * m * size)
    weights = waves.model_._weights.size + waves.model_.frequencies_.size  # without the constants
    assert benchmark.work(waves, 1)["bytes"] == 8 * (weights + m + size + inputs + size)
