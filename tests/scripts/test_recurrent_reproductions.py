"""`reproduce recurrent-returns` and `recurrent-hypotheses`: their measures, and small versions from end to end."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium.spaces import Discrete
from sklearn.linear_model import Ridge
from sklearn.metrics import r2_score

from beliefgym.agents import make_agent
from beliefgym.scripts.reproductions import recurrent_hypotheses as hypotheses
from beliefgym.scripts.reproductions import recurrent_methods as methods
from beliefgym.scripts.reproductions import recurrent_returns as returns
from beliefgym.scripts.reproductions.recurrent_decoding import RIDGE, decodability, hidden_state, linear_r2
from beliefgym.scripts.reproductions.report import Request
from beliefgym.wrappers.task import Task

BALANCE = Task("beliefgym/CartPoleBalancePosition-v0")


# ---- decodability


def test_r2_is_that_of_ridge_regression():
    rng = np.random.default_rng(0)
    h, test = rng.standard_normal((300, 6)), rng.standard_normal((200, 6)) + 0.3
    weights = rng.standard_normal((6, 2))
    s, s_test = (x @ weights + 0.5 * rng.standard_normal((len(x), 2)) for x in (h, test))
    model = Ridge(alpha=RIDGE * len(h)).fit((h - h.mean(0)) / h.std(0), s)
    expected = r2_score(s_test, model.predict((test - h.mean(0)) / h.std(0)), multioutput="raw_values")
    np.testing.assert_allclose(linear_r2(h, s, test, s_test), expected, rtol=1e-9)


def test_r2_of_what_does_not_vary_is_none():
    h = np.random.default_rng(0).standard_normal((50, 3))
    scores = linear_r2(h, np.ones((50, 1)), h, np.ones((50, 1)))
    assert np.isnan(scores).all()


def test_velocities_can_be_read_from_a_stack_and_not_from_one_observation():
    task = Task("beliefgym/PendulumPosition-v0")
    stack, alone, lstm = (
        make_agent("recurrent-q", task, seed=0, cell=cell, auxiliary={})
        for cell in ("stack2", "none", "lstm")
    )
    assert decodability(alone, task, 8, seed=1) is None  # no memory, nothing to read
    found = decodability(stack, task, 8, seed=1)
    assert set(found) == {"cos_theta", "sin_theta", "angular_velocity"}
    assert 0.2 < decodability(lstm, task, 8, seed=1)["cos_theta"] < 1.0


def test_hidden_states_are_found_in_what_predict_returns():
    agent = make_agent("recurrent-q", BALANCE, seed=0)
    observation = np.zeros((3, 2), dtype=np.float32)
    _, state = agent.predict(observation)
    assert hidden_state(state).shape == (3, 128)
    assert hidden_state(None) is None


# ---- returns


@pytest.fixture
def small_returns(monkeypatch):
    for name, value in {
        "TEST_EPISODES": 4,
        "TUNING_EPISODES": 2,
        "CURVE_POINTS": 2,
        "CURVE_EPISODES": 2,
    }.items():
        monkeypatch.setattr(returns, name, value)
    monkeypatch.setattr(returns, "SEARCH", {"popsize": 1, "maxiter": 1})
    kept = {
        key: replace(returns.AIMS[key], steps=1024) for key in ("cart-pole", "cart-pole-easy", "pendulum-sac")
    }
    monkeypatch.setattr(returns, "AIMS", kept)


def test_a_small_table_of_returns(small_returns, tmp_path):
    told = []
    request = Request(seed=3, seeds=2, jobs=1, folder=tmp_path, told=told.append)
    report = returns.run(request)
    assert not report.notes
    whats = [row["what"].split(", k =")[0] for row in report.rows]
    assert whats == [
        "cart-pole, positions: recurrent-q",
        "cart-pole, noise 0.1: recurrent-q",
        "cart-pole, noise 0.1: Kalman filter, LQR",
        "cart-pole, noise 0.1: Kalman filter, tuned",
        "pendulum, position: recurrent-sac",
    ]
    assert report.rows[0]["meets"] is False
    assert report.rows[0]["solved early"] == "0 of 2, at the end 0"
    assert 0.5 < report.rows[2]["values"]["mean"] <= 1.0
    assert len(report.rows[3]["values"]["gain"]) == 4
    assert (tmp_path / "recurrent-returns.png").stat().st_size > 10_000
    assert len(told) == 8
    again = returns.run(request)
    assert len(told) == 8  # nothing was run again
    assert again.rows == report.rows


def _result(curve, end):
    points = [{"step": step, "mean_return": value} for step, value in curve]
    return {"curve": points, "returns": [end] * 5}


def test_solved_is_early_and_still_at_the_end():
    aim = returns.AIMS["cart-pole"]
    good = _result([(40_000, 500.0), (60_000, 300.0)], 500.0)
    late, lost = _result([(50_000, 500.0)], 500.0), _result([(10_000, 500.0)], 499.0)
    row = returns._row(aim, [good] * 9 + [late])
    assert row["solved early"] == "9 of 10, at the end 10"
    assert row["meets"] is True
    assert returns._row(aim, [good] * 8 + [late, lost])["meets"] is False


def test_under_noise_the_score_is_a_share_of_200_steps():
    row = returns._row(
        returns.AIMS["cart-pole-easy"], [_result([(1, 1.0)], 198.0), _result([(1, 1.0)], 196.0)]
    )
    assert row["values"]["means"] == [0.99, 0.98]
    assert row["meets"] is True


# ---- hypotheses


def test_a_small_comparison(monkeypatch, tmp_path):
    for name, value in {
        "TEST_EPISODES": 4,
        "CURVE_POINTS": 2,
        "CURVE_EPISODES": 2,
        "DECODING_EPISODES": 4,
    }.items():
        monkeypatch.setattr(methods, name, value)
    monkeypatch.setattr(
        hypotheses, "SETTINGS", {"cart-pole": replace(methods.SETTINGS["cart-pole"], steps=1024)}
    )
    names = ("SARSA", "DRQN, random", "RecurrentPPO", "DQN of SB3, stack of 4", "predictive state")
    monkeypatch.setattr(hypotheses, "METHODS", {name: methods.METHODS[name] for name in names})
    report = hypotheses.run(Request(seed=3, seeds=2, jobs=1, folder=tmp_path, told=lambda _: None))
    assert not report.notes
    rows = {row["what"]: row for row in report.rows}
    assert {f"cart-pole, positions: {name}" for name in names} <= set(rows)
    claim = rows["cart-pole, positions, H5: SARSA over DRQN, random"]
    ours, theirs = (
        rows[f"cart-pole, positions: {n}"]["values"]["return"]["value"] for n in ("SARSA", "DRQN, random")
    )
    assert claim["values"]["difference"]["value"] == pytest.approx(ours - theirs)
    assert "cart-pole, positions, H6: predictive state over SARSA" in rows
    assert "state off" in rows["cart-pole, positions: SARSA"]
    assert (tmp_path / "recurrent-hypotheses.png").stat().st_size > 10_000


def test_shares_of_all_tasks_lie_between_untrained_and_best():
    found = {
        ("cart-pole", "SARSA"): {
            0: _result([(0, 10.0), (9, 1.0)], 110.0),
            1: _result([(0, 10.0)], 90.0),
            2: _result([(0, 10.0)], 100.0),
        },
        ("cart-pole", "PQN"): {0: _result([(0, 10.0)], 55.0), 1: _result([(0, 10.0)], 35.0)},
        ("pendulum", "SARSA"): {
            0: _result([(0, -1200.0)], -700.0),
            1: _result([(0, -1000.0)], -700.0),
        },
        ("pendulum", "PQN"): {0: _result([(0, -1100.0)], -300.0), 1: _result([(0, -1100.0)], -300.0)},
    }
    shares = hypotheses.shares(found)
    assert shares["SARSA"] == pytest.approx({0: (100 / 90 + 0.5) / 2, 1: (80 / 90 + 0.5) / 2})
    assert shares["PQN"] == pytest.approx({0: (45 / 90 + 1.0) / 2, 1: (25 / 90 + 1.0) / 2})
    rows = {row["what"]: row for row in hypotheses._rows_of_all(found)}
    gap = rows["All tasks, H5: SARSA over PQN"]["values"]["difference"]
    assert gap["value"] == pytest.approx((55 / 90 - 0.5) / 2)


def test_seeds_of_a_method():
    def count(task, method):
        return sum(methods.compared(task, method, seed) for seed in range(20))

    assert count("acrobot", "SARSA") == 20
    assert count("acrobot", "DRQN, random") == 10
    assert count("acrobot", "PQN") == count("cart-pole", "dynamics") == 5
    assert count("acrobot", "dynamics") == 0


def test_a_grid_and_a_discount_reach_every_agent():
    setting = methods.SETTINGS["pendulum"]
    assert methods.placed(setting, "drqn", {"double": True}) == (
        setting.task,
        {"bins": 9, "gamma": 0.95, "double": True},
    )
    task, options = methods.placed(setting, "recurrent-ppo", {"n_envs": 2, "arguments": {"n_steps": 8}})
    assert task.make().action_space == Discrete(9)
    assert options == {"n_envs": 2, "arguments": {"gamma": 0.95, "n_steps": 8}}
