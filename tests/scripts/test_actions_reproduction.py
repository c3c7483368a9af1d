"""`reproduce actions-interventions`: its exact expectations against brute force, its measures, its record."""

import json
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose

from beliefgym.learning import PSIM, Ridge
from beliefgym.learning.psim_actions import PSIMActions
from beliefgym.scripts.cli import main
from beliefgym.scripts.reproductions import actions_interventions as reproduction
from beliefgym.scripts.reproductions import actions_methods as methods
from beliefgym.scripts.reproductions.actions_data import Colour, Feedback, LinearWorld, RingWorld
from beliefgym.scripts.reproductions.actions_pendulum import Swing

LINEAR, RING = LinearWorld(), RingWorld()
KINDS = [Feedback(0.8), Feedback(0.9, "estimate")]


def drawn(world, policy, n, n_steps, seed=0):
    return world.sample(policy, n, n_steps, np.random.default_rng(seed))


# ---- the linear world


def test_the_linear_filter_is_joint_gaussian_conditioning():
    """E[s_3 | x_0 .. x_2, a_0 .. a_2] from the covariance of everything, written out."""
    a, b, c = LINEAR.matrices
    q, _ = LINEAR.noise
    data = drawn(LINEAR, KINDS[1], 2, 4)
    states = [np.eye(3, 12)]  # s_t in terms of s_0 and the noises of three steps
    for t in range(3):
        states.append(a @ states[-1] + np.eye(3, 12, 3 * (t + 1)))
    source = np.zeros((12, 12))
    source[:3, :3] = LINEAR.start
    source[3:, 3:] = np.kron(np.eye(3), q)
    seen = np.concatenate([c @ s for s in states[:3]])
    gain = (
        states[3]
        @ source
        @ seen.T
        @ np.linalg.inv(seen @ source @ seen.T + LINEAR.measurement**2 * np.eye(3))
    )
    for i in range(2):
        pushed = [np.zeros(3)]
        for t in range(3):
            pushed.append(a @ pushed[-1] + b[:, 0] * data.actions[i, t, 0])
        surprise = data.observations[i, :3, 0] - np.array([(c @ p)[0] for p in pushed[:3]])
        assert_allclose(LINEAR.known(data)[i, 3], pushed[3] + gain @ surprise, atol=1e-12)


@pytest.mark.parametrize("policy", KINDS, ids=["observation", "estimate"])
def test_the_future_under_feedback_is_what_trajectories_do(policy):
    """Regression of what came on what was known gives the closed loop's matrix, to five standard errors."""
    data = drawn(LINEAR, policy, 20_000, 14)
    known = LINEAR.known(data)[:, 10]
    for i in (1, 3):
        coefficients, residual, *_ = np.linalg.lstsq(known, data.observations[:, 10 + i, 0], rcond=None)
        exact = LINEAR.under_policy(np.eye(3), policy, 4)[:, i, 0]
        error = np.sqrt(np.diag(np.linalg.inv(known.T @ known)) * residual[0] / len(known))
        assert (np.abs(coefficients - exact) < 5 * error).all()
        blind = LINEAR.under_reference(np.eye(3), np.zeros((1, 1)), 4)[:, i, 0]
        assert (np.abs(blind - exact) > 10 * error).any()  # the test would see the difference


def test_prescribed_actions_leave_the_least_error():
    data = drawn(LINEAR, Feedback(0.0), 4000, 40)
    known = LINEAR.known(data)[:, 30]
    expected = LINEAR.under_actions(known, data.actions[:, 30:], 6)
    squared = np.square(data.observations[:, 30:36] - expected)[:, :, 0]
    # the standard error of a mean of 4000 squares is 2.2 % of it
    assert_allclose(squared.mean(axis=0), LINEAR.least_errors(known, data.actions, 6), rtol=0.1)


def test_gain_one_takes_back_all_that_is_foreseen():
    policy = Feedback(1.0, "estimate")
    known = np.random.default_rng(0).normal(size=(5, 3))
    assert_allclose(LINEAR.under_policy(known, policy, 6)[:, 1:], 0.0, atol=1e-12)


@pytest.mark.parametrize("policy", KINDS, ids=["observation", "estimate"])
def test_log_probabilities_and_divergence_are_those_of_the_policy(policy):
    """KL is the mean log-ratio of densities."""
    data, other = drawn(LINEAR, policy, 400, 30), Feedback(0.2, policy.sees, std=0.9)
    x, known = data.observations[:, :-1], LINEAR._filtered(data)[1][:, :-1]
    densities = []
    for one in (policy, other):
        z = (data.actions - LINEAR.mean_action(one, x, known))[:, :, 0] / one.std
        densities.append(-0.5 * z**2 - np.log(one.std * np.sqrt(2 * np.pi)))
    assert_allclose(data.action_log_probs, densities[0], atol=1e-9)
    ratios = densities[0] - densities[1]
    error = ratios.std() / ratios.size**0.5
    assert abs(LINEAR.divergence(policy, other, data) - ratios.mean()) < 5 * error


# ---- the ring


def paths(start, policy, n):
    """Every course of n steps from a belief: probability, places, colours, actions."""
    moves, seen = RING.matrices
    table = policy if callable(policy) else (lambda x, a: policy.table[x, a])
    for places in product(range(5), repeat=n + 1):
        for colours, actions in product(product(range(3), repeat=n + 1), product(range(2), repeat=n)):
            p = start[places[0]] * seen[places[0], colours[0]]
            for t in range(n):
                p *= table(colours[t], actions[t]) * moves[actions[t], places[t], places[t + 1]]
                p *= seen[places[t + 1], colours[t + 1]]
            yield p, places, colours, actions


def test_the_rings_filter_and_futures_are_sums_over_courses():
    data = drawn(RING, Colour(0.9), 3, 3)
    colour = data.observations.argmax(axis=2)
    start, policy = np.full(5, 0.2), Colour(0.6)
    blind = lambda x, a: (0.3, 0.7)[a]  # noqa: E731
    recorded = np.repeat([[0.0], [1.0]], [30, 70], axis=0)
    by_history = np.zeros((3, 5))
    for p, places, colours, actions in paths(start, Colour(0.9), 2):
        for i in range(3):
            if colours[:2] == tuple(colour[i, :2]) and actions == tuple(data.actions[i, :2, 0]):
                by_history[i, places[2]] += p
    known = RING.known(data)[:, 2]
    assert_allclose(known, by_history / by_history.sum(axis=1, keepdims=True), atol=1e-12)
    for law, found in (
        (policy, RING.under_policy(known[:1], policy, 3)),
        (blind, RING.under_reference(known[:1], recorded, 3)),
        (lambda x, a: float(a == 1), RING.under_actions(known[:1], np.ones((1, 2, 1)), 3)),
    ):
        expected = np.zeros((3, 3))
        for p, _, colours, _ in paths(known[0], law, 2):
            expected[np.arange(3), colours] += p
        assert_allclose(found[0], expected, atol=1e-12)


def test_the_rings_least_error_and_probabilities_are_those_of_its_draws():
    data = drawn(RING, Colour(0.0), 6000, 12)
    known = RING.known(data)[:, 8]
    expected = RING.under_actions(known, data.actions[:, 8:], 4)
    squared = np.square(data.observations[:, 8:12] - expected).sum(axis=2).mean(axis=0)
    assert_allclose(squared, RING.least_errors(known, data.actions[:, 8:], 4), rtol=0.05)
    policy = Colour(0.5)
    recorded = drawn(RING, policy, 2000, 10)
    colour = recorded.observations[:, :-1].argmax(axis=2)
    taken = recorded.actions[:, :, 0].astype(int)
    assert_allclose(recorded.action_log_probs, np.log(policy.table[colour, taken]))
    assert abs(taken[colour != 1].mean() - 0.75) < 0.02
    other = Colour(-0.5)
    ratios = recorded.action_log_probs - np.log(other.table[colour, taken])
    assert abs(RING.divergence(policy, other, recorded) - ratios.mean()) < 5 * ratios.std() / ratios.size**0.5


# ---- the pendulum


def test_the_pendulums_mean_action_is_the_recorded_one():
    """Recomputed from positions alone, it gives the recorded log-probabilities."""
    policy = Swing(-0.3)
    data = policy.sample(6, 20, seed=3)
    assert data.observations.shape == (6, 21, 2)
    z = (data.actions[:, :, 0] - policy.mean_actions(data)) / policy.std
    logs = -0.5 * z**2 - np.log(policy.std * np.sqrt(2 * np.pi))
    assert_allclose(data.action_log_probs, logs, atol=1e-5)  # actions are float32
    assert np.abs(policy.mean_actions(data)).max() <= 0.3 * policy.LIMIT + 1e-12
    assert policy.divergence(policy, data) == 0.0


# ---- what is measured


class Exact:
    """The exact filter with a filter's face."""

    n_obs_, n_future = 1, 4

    def beliefs(self, sequences):
        known = LINEAR.known(sequences)
        return np.concatenate([known, known[:, -1:]], axis=1)

    def forecast(self, belief, horizon, actions):
        return LINEAR.under_actions(belief, actions, horizon)


def test_the_exact_filter_has_no_excess():
    data = drawn(LINEAR, KINDS[0], 5, 30)
    assert_allclose(methods.excess(LINEAR, Exact(), data), 0.0, atol=1e-20)


def test_the_distances_tell_do_from_the_recorded_policy(monkeypatch):
    policy, data = KINDS[0], drawn(LINEAR, KINDS[0], 5, 30)
    for law, near, far in (("under_policy", "own", "do"), ("under_reference", "do", "own")):
        argument = policy if law == "under_policy" else data.actions[data.step_mask]
        monkeypatch.setattr(
            methods, "blocks", lambda _, b, law=law, a=argument: getattr(LINEAR, law)(b, a, 4)
        )
        found = methods.of_beliefs(LINEAR, Exact(), policy, data, data)
        assert found[near] == pytest.approx(0.0, abs=1e-12)
        assert found[far] == pytest.approx(found["gap"])
        assert found["gap"] > 0.05


def test_blocks_are_the_observations_that_a_belief_holds():
    data = drawn(RING, Colour(0.5), 20, 20)
    plain = PSIM(Ridge(), n_future=3, n_iterations=1).fit(data)
    beliefs = plain.beliefs(data)[:, 5]
    assert_allclose(methods.blocks(plain, beliefs), plain.forecast(beliefs, 3), atol=1e-12)
    joint = PSIMActions(Ridge(), n_future=3, n_iterations=1, state="joint", n_choices=2).fit(data)
    held = methods.blocks(joint, joint.beliefs(data)[:, 5])
    assert held.shape == (20, 3, 3)
    assert_allclose(held.sum(axis=2), 1.0, atol=0.05)  # of one-hot colours, each on its own scale


def test_the_validation_error_alone_chooses():
    cell = {"world": "output", "settings": [{"alpha": 1e-6}, {"alpha": 1e3}], "n_iterations": 1, "seed": 0}
    train, validation = drawn(LINEAR, KINDS[0], 30, 30), drawn(LINEAR, KINDS[0], 20, 30, seed=1)
    (chosen, setting, error), by_k = methods.tuned(methods.DECISION, cell, [2, 3], train, validation)
    assert setting["alpha"] == 1e-6
    assert error == min(f.errors(validation).mean for f in by_k.values()) == chosen.errors(validation).mean
    assert set(by_k) == {2, 3}
    assert 0 < methods.effective(chosen) < 1 == methods.effective(PSIM())


# ---- the record


def test_the_record_holds_both_tables_and_its_claims(tmp_path, monkeypatch, capsys):
    small = {
        "sizes": (25, 8, 8),
        "n_steps": 24,
        "n_future": (3,),
        "settings": ({"alpha": 1e-4},),
        "few": (1, 2),
        "opposite": -0.1,
    }
    worlds = dict.fromkeys(("output", "cancelling"), small) | {
        "ring": small | {"few": (), "opposite": -0.9},
        "swing": small | {"few": (), "opposite": 0.1},
    }
    levels = {"output": (0.0, 1.0), "cancelling": (0.0, 1.0), "ring": (0.0, 0.9)}
    monkeypatch.setattr(reproduction, "WORLDS", worlds)
    monkeypatch.setattr(reproduction, "LEVELS", levels | {"swing": (0.0, -0.3)})
    monkeypatch.setattr(reproduction, "N_ITERATIONS", 1)
    with pytest.raises(SystemExit) as ended:
        main(["reproduce", "actions-interventions", "--seeds", "2", "--results", str(tmp_path)])
    assert ended.value.code == 0
    folder = tmp_path / "reproduction"
    record = json.loads((folder / "actions-interventions.json").read_text())
    cells = {
        f.stem: json.loads(f.read_text())["result"]
        for f in (folder / "cells" / "actions-interventions").iterdir()
    }
    assert len(cells) == 4 * 2 * 2
    rows = {row["what"]: row for row in record["rows"]}
    row = rows[f"linear, feedback of the observation, A strong feedback: {methods.DECISION}"]
    each = [cells[f"output-1-{s}"]["methods"][methods.DECISION] for s in (0, 1)]
    errors = [1 + one["excess"]["blind"][2] for one in each]
    assert row["values"]["blind"]["5 ahead"]["value"] == pytest.approx(np.exp(np.mean(np.log(errors))))
    assert row["values"]["do"]["value"] == pytest.approx(
        np.prod([one["do"] / one["gap"] for one in each]) ** 0.5
    )
    rival = [cells[f"output-1-{s}"]["methods"][methods.UNWEIGHED] for s in (0, 1)]
    ratio = np.prod([a["do"] / b["do"] for a, b in zip(each, rival, strict=True)]) ** 0.5
    claim = rows[
        f"linear, feedback of the observation, belief from do(): {methods.DECISION} over {methods.UNWEIGHED}"
    ]
    assert claim["values"]["ratio"]["value"] == pytest.approx(ratio)
    assert claim["meets"] == (ratio < 1)
    assert "k = 2" in " ".join(record["notes"])
    assert (folder / "actions-interventions.png").stat().st_size > 10_000
    assert not any("Failed" in note for note in record["notes"])
