"""The DAgger loop: its schedule and accounts, and that with the true model in it the expert comes out."""

import warnings
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy

from beliefgym.agents import (
    Expert,
    Exploration,
    RecedingHorizonSynthesis,
    RegulatorSynthesis,
    SystemIdentification,
)
from beliefgym.agents.coordinates import Coordinates
from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.collect import collect
from beliefgym.envs.helicopter import Helicopter
from beliefgym.envs.planning.model_lqr import ModelWarning, wrapped_difference
from beliefgym.learning import DataAsDemonstrator, PolynomialRidge, Ridge
from beliefgym.learning.dynamics import DynamicsModel
from beliefgym.wrappers import Task

PENDULUM, CART_POLE = "beliefgym/Pendulum-v0", "beliefgym/CartPoleSwingUp-v0"
quiet = pytest.mark.filterwarnings("ignore::beliefgym.envs.planning.model_lqr.ModelWarning")  # told elsewhere
SYSTEMS = {"cart-pole": CartPole(), "helicopter": Helicopter(wrench_noise_std=0.0)}


class TrueModel(DynamicsModel):
    """The true system in coordinates, in the place of a learned model: `fit` learns nothing."""

    def __init__(self, system="cart-pole", angles=None):
        self.system, self.angles = system, angles
        self.target, self.standardise, self.use_actions, self.divergence_limit = "delta", False, True, 1e6

    def fit(self, train, validation=None):
        self._begin(train, validation)
        self.model_ = None
        return self

    def _step(self, z, u):
        system = SYSTEMS[self.system]
        coordinates = Coordinates.of(system.observation_names, system)
        state = coordinates.cost_of(system).state(z)
        after = coordinates.encode(system.observe(system.flow(state, u)))
        return z + wrapped_difference(after, z, coordinates.angles)


def single_step(regressor=None, **how):
    return DataAsDemonstrator(Ridge() if regressor is None else regressor, n_iterations=0, **how)


def small(env=PENDULUM, **how):
    """Quick: straight lines, a regulator, trials of 12 steps."""
    settings = {"model": single_step(), "synthesis": RegulatorSynthesis(), "trial_steps": 12}
    return SystemIdentification(env, seed=3, **(settings | how))


# ------------------------------------------------------------------------------------- on the true model: the expert


def test_on_the_true_model_the_loop_reproduces_the_helicopters_expert():
    task = Task("beliefgym/HelicopterHover-v0", {"wrench_noise_std": 0.0, "start_distance": 1.0})
    agent = SystemIdentification(
        task,
        model=TrueModel("helicopter"),
        synthesis=RegulatorSynthesis(),
        exploration=Exploration("expert"),
        target=(
            Coordinates.of(Helicopter.observation_names, Helicopter()).encode(Helicopter().trim),
            np.zeros(4),
        ),
        trial_steps=60,
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*do not vary in the training data")
        agent.run_iterations(1)
    system = SYSTEMS["helicopter"]
    rng = np.random.default_rng(0)
    states = np.tile(system.trim, (20, 1))
    states[:, :17] += 0.01 * rng.normal(size=(20, 17))
    half = 0.01 * rng.normal(size=(20, 3))
    states[:, 17:20] += half  # a turn of about 0.01 rad, normalised to first order
    states[:, 17:] /= np.linalg.norm(states[:, 17:], axis=1, keepdims=True)
    states[10:, 17:] *= -1.0  # the same attitudes
    expected = system.expert().act(states)
    found, _ = agent.predict(states.astype(np.float32))
    # float32 of observations near 1 m (1e-8 here), the derivatives' 1e-10 and R's 1e-9 of the largest weight
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(expected).max() > 0.01
    # and so the policy's trial costs what the expert's costs from that start
    start = int(np.random.SeedSequence([0, 1]).generate_state(1)[0])
    expert = Expert(task)
    env = task.make()
    expert.set_env(env)
    trial = collect(env, expert, 1, start, max_steps_per_episode=60)
    cost = system.stage_cost(trial.states[0, :60], trial.actions[0, :60]).sum()
    assert agent.history[1]["kind"] == "policy"
    # both linearise at trim: they differ only by float32 and the weights' 1e-9
    assert agent.history[1]["cost"] == pytest.approx(cost, rel=1e-4)


def test_on_the_true_model_the_loop_swings_the_cart_pole_up_as_the_expert_does():
    task = Task(CART_POLE)
    agent = SystemIdentification(
        task,
        model=TrueModel("cart-pole"),
        synthesis=RecedingHorizonSynthesis(horizon=40, every=3, candidates=4, iterations=15, again=2),
        trial_steps=100,
    )
    agent.run_iterations(1)
    assert agent.model.angles is None, "only the clone is told of the angles"
    assert tuple(agent.dynamics.angles) == (1,)
    trial = agent.trials[1]
    end = trial.states[0, 100]
    turned = wrapped_difference(end, np.zeros(4), (2,))
    assert np.abs(turned).max() < 0.05, "upright and at rest in the middle, after 5 s"
    expert = Expert(task)
    env = task.make()
    expert.set_env(env)
    theirs = collect(
        env, expert, 1, int(np.random.SeedSequence([0, 1]).generate_state(1)[0]), max_steps_per_episode=100
    )
    np.testing.assert_array_equal(theirs.states[0, 0], trial.states[0, 0])  # the same start
    cost = SYSTEMS["cart-pole"].stage_cost(theirs.states[0, :100], theirs.actions[0, :100]).sum()
    # the expert minimises what the reward lacks, not this cost: ours should not be above it
    assert agent.history[1]["cost"] < 1.05 * cost


# ---------------------------------------------------------------------------------------------------------- schedule


def test_trials_follow_the_schedule_and_every_step_is_counted():
    agent = small(initial_trials=2, policy_trials=2, exploration_trials=1).run_iterations(2)
    explored, policy = "exploration", "policy"
    kinds = [(one["kind"], one["iteration"]) for one in agent.history]
    assert kinds == [
        (explored, 0),
        (explored, 0),
        (policy, 1),
        (policy, 1),
        (explored, 1),
        (policy, 2),
        (policy, 2),
    ]
    assert [one["steps"] for one in agent.history] == [12] * 7
    assert agent.num_timesteps == 7 * 12
    assert [one["trials"] for one in agent.models] == [2, 5]
    assert [one["n_transitions"] for one in agent.models] == [24, 60]
    assert [one["interaction_steps"] for one in agent.models] == [24, 60]
    assert [one["interaction_seconds"] for one in agent.models] == pytest.approx([24 * 0.05, 60 * 0.05])
    for model, trials in zip(agent.models, (agent.history[2:4], agent.history[5:7]), strict=True):
        assert model["cost"] == pytest.approx(np.mean([one["cost"] for one in trials]))
    agent.run_iterations(1)
    assert [one["kind"] for one in agent.history[7:]] == [explored, policy, policy], "it goes on where it was"
    assert [one["trials"] for one in agent.models] == [2, 5, 8]


def test_learn_runs_whole_trials_until_the_steps_are_used_and_goes_on_later():
    agent = small().learn(25)
    assert [one["kind"] for one in agent.history] == ["exploration", "policy", "policy"]
    assert agent.num_timesteps == 36
    assert [one["trials"] for one in agent.models] == [1, 2, 3], "the last data have their model too"
    assert agent.models[-1]["cost"] is None
    agent.learn(1)
    assert agent.num_timesteps == 48
    once = small().learn(48)
    for one, other in zip(agent.trials, once.trials, strict=True):
        np.testing.assert_array_equal(one.observations, other.observations)
    assert agent.fit_policy() is agent
    assert [one["trials"] for one in agent.models] == [1, 2, 3, 4], "there was nothing newer to fit"
    with pytest.raises(ValueError, match="expected total_timesteps of at least 1, got 0"):
        agent.learn(0)


def test_the_data_are_what_was_seen_and_the_actions_that_were_applied():
    agent = small(exploration=Exploration(std=3.0), initial_trials=2).learn(30)
    data = agent.dataset()
    assert data.n_episodes == 3
    trial = agent.trials[1]
    theta = np.arctan2(trial.observations[0, :, 1], trial.observations[0, :, 0])
    np.testing.assert_allclose(data.observations[1, :, 0], theta, atol=1e-12)
    np.testing.assert_array_equal(data.observations[1, :, 1], trial.observations[0, :, 2])
    np.testing.assert_array_equal(data.actions[1], np.clip(trial.actions[0], -2.0, 2.0))


@quiet
def test_a_trial_that_ends_early_is_charged_its_last_stage_cost_to_the_end():
    task = Task(CART_POLE, {"track": 0.15, "start_spread": 0.05})
    agent = SystemIdentification(
        task,
        model=single_step(),
        synthesis=RegulatorSynthesis(),
        trial_steps=50,
        exploration=Exploration(hold=50),
    )
    agent.learn(1)
    one, trial = agent.history[0], agent.trials[0]
    assert one["terminated"]
    steps = one["steps"]
    assert steps < 50
    assert one["seconds"] == pytest.approx(steps * SYSTEMS["cart-pole"].dt)
    stage = SYSTEMS["cart-pole"].stage_cost(trial.states[0, :steps], trial.actions[0, :steps])
    assert one["cost"] == pytest.approx(stage.sum() + (50 - steps) * stage[-1], rel=1e-9)
    assert one["return"] == pytest.approx(trial.rewards[0, :steps].sum())
    unlimited = SystemIdentification(
        task, model=single_step(), synthesis=RegulatorSynthesis(), exploration=Exploration(hold=50)
    )
    unlimited.learn(1)
    assert unlimited.history[0]["steps"] == steps
    # to the environment's own end, after 200 steps
    assert unlimited.history[0]["cost"] == pytest.approx(stage.sum() + (200 - steps) * stage[-1], rel=1e-9)


def test_the_best_policy_is_that_of_the_lowest_mean_cost_and_last_is_last():
    agent = small(policy_trials=2).run_iterations(3)
    costs = [5.0, 2.0, 2.0]
    for model, cost in zip(agent.models, costs, strict=True):
        model["cost"] = cost
    assert agent.best_iteration == 1, "of equals the first"
    assert agent.policy is agent._policies[1]
    assert agent.dynamics is agent._fitted[1]
    agent.models[2]["cost"] = None  # not run to its end
    assert agent.best_iteration == 1
    agent.act_with = "last"
    assert agent.best_iteration == 2
    one, _ = agent.predict(np.array([0.9, 0.1, 0.2]))
    memory = agent._policies[2].begin(1)
    x = agent.coordinates.encode(np.array([[0.9, 0.1, 0.2]]))
    np.testing.assert_allclose(
        one, agent._policies[2].act(x, memory, np.ones(1, dtype=bool))[0], rtol=1e-6
    )  # float32


# ----------------------------------------------------------------------------------------------------- SB3's face


class Counts(BaseCallback):
    """Notes num_timesteps at every call; says once, at a call in the middle of a trial, that it is enough."""

    def __init__(self, stop=np.inf):
        super().__init__()
        self.stop, self.seen, self.events = stop, [], []

    def _on_training_start(self):
        self.events.append("start")

    def _on_training_end(self):
        self.events.append("end")

    def _on_step(self):
        self.seen.append(self.num_timesteps)
        return self.n_calls != self.stop


@pytest.mark.parametrize("as_list", [False, True])
def test_an_sb3_callback_is_called_once_a_step_and_may_end_the_learning(as_list):
    counts, agent = Counts(), small()
    agent.learn(30, callback=[counts] if as_list else counts)
    assert agent.num_timesteps == 36
    assert counts.seen == list(range(1, 37))
    assert counts.events == ["start", "end"]
    assert counts.model is agent
    again = Counts()
    agent.learn(1, callback=again)
    assert again.seen == list(range(37, 49))
    stopping, stopped = Counts(stop=15), small()
    stopped.learn(1000, callback=stopping)
    assert stopped.num_timesteps == 24, "the trial is over when it is called"
    assert len(stopping.seen) == 24
    assert stopping.events == ["start", "end"]
    calls = []
    small().learn(1000, callback=lambda its, _: calls.append(its["kind"]) or len(calls) < 3)
    assert calls == ["exploration", "policy", "policy"]


def test_sb3s_evaluate_policy_takes_the_agent():
    agent = small(trial_steps=30).learn(60)
    env = gym.make(PENDULUM)
    mean, _ = evaluate_policy(agent, env, n_eval_episodes=1, warn=False)
    assert np.isfinite(mean)
    assert mean < 0.0


@pytest.mark.parametrize("delays", [1, 3])
def test_copies_act_as_one_by_one_and_restart_by_themselves(delays):
    agent = small(CART_POLE, delays=delays, trial_steps=30).learn(60)
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(9, 3, 5)) * 0.1
    seen[:, :, 1] = 1.0
    starts = np.zeros((9, 3), dtype=bool)
    starts[0], starts[4, 1] = True, True
    state, together = None, []
    for t in range(9):
        action, state = agent.predict(seen[t], state, starts[t])
        together.append(action)
    for i in range(3):
        state = None
        for t in range(9):
            action, state = agent.predict(seen[t, i], state, starts[t, i : i + 1])
            # float32 of actions up to 10, and BLAS's summation of one row
            np.testing.assert_allclose(action, together[t][i], atol=1e-5)
            assert agent.action_space.contains(action)


def test_before_anything_was_learned_the_targets_action_is_taken():
    agent = small(target=([0.0, 0.0], [0.5]))
    np.testing.assert_array_equal(agent.predict(np.zeros((2, 3)))[0], [[0.5], [0.5]])
    with pytest.raises(
        RuntimeError, match=r"expected a learned policy, got none; call learn\(total_timesteps\) first"
    ):
        _ = agent.best_iteration
    with pytest.raises(ValueError, match=r"expected trials to learn from, got none; call learn"):
        agent.dataset()
    assert agent.fit_policy().models == []


# ----------------------------------------------------------------------------------------------- models that fail


@quiet
def test_a_model_that_cannot_be_stabilised_is_told_and_the_loop_goes_on():
    agent = small(model=single_step(use_actions=False))  # no action moves it, and the pendulum falls
    with pytest.warns(
        ModelWarning, match="iteration 1: the model's linearisation .* no stabilising regulator"
    ):
        agent.learn(40)
    assert agent.num_timesteps == 48
    assert all(any("no stabilising regulator" in one for one in model["told"]) for model in agent.models)
    assert np.isfinite([one["cost"] for one in agent.history]).all()
    for trial in agent.trials:
        assert np.isfinite(trial.actions).all()


@dataclass(frozen=True)
class Refuses:
    """A synthesis that cannot make a policy at its first calls."""

    calls: list
    good: tuple

    def policy(self, model, target, action, angles):
        self.calls.append(0)
        if len(self.calls) not in self.good:
            raise ValueError("the plan is not finite")
        return RegulatorSynthesis().policy(model, target, action, angles)


def test_a_model_without_a_policy_is_stepped_over_by_the_one_before_or_the_targets_action():
    agent = small(synthesis=Refuses([], good=(2,)), target=([0.0, 0.0], [0.25]))
    with pytest.warns(
        ModelWarning, match=r"iteration 1: no policy .*\(the plan is not finite\).*target's action throu"
    ):
        agent.learn(24)
    np.testing.assert_array_equal(agent.trials[1].actions, np.float32(0.25))
    with pytest.warns(
        ModelWarning, match="iteration 3: no policy could be made .* goes on with the policy before"
    ):
        agent.learn(12)
    assert agent._policies[2] is agent._policies[1]


def test_rollouts_of_the_model_that_diverge_are_told():
    agent = small(model=single_step(PolynomialRidge(degree=5), divergence_limit=0.5))
    with pytest.warns(
        ModelWarning, match="trials diverge when the model predicts them from their first state"
    ):
        agent.learn(12)


# -------------------------------------------------------------------------------------------- states, costs, filters


def test_positions_alone_are_a_state_by_delays():
    agent = SystemIdentification(
        "beliefgym/CartPoleSwingUpPosition-v0",
        model=single_step(PolynomialRidge(degree=2)),
        synthesis=RecedingHorizonSynthesis(horizon=10, candidates=2, iterations=3, every=5),
        delays=2,
        trial_steps=30,
    ).learn(60)
    data = agent.dataset()
    assert data.n_obs == 2 * 2 + 1
    assert agent.target[0].shape == (5,)
    true = agent.trials[0].states[0]  # x, velocity, theta, angular velocity
    belief = data.observations[0]
    np.testing.assert_allclose(
        belief[:, 0], true[1:31, 0], atol=1e-6
    )  # float32; the first step has no rate yet
    # a difference over one step is the mean velocity of the step: off by half a step's acceleration, 25 m/s^2
    np.testing.assert_allclose(belief[:, 2], true[1:31, 1], atol=0.05 * 25)
    np.testing.assert_allclose(belief[:, 2], np.diff(true[:31, 0]) / 0.05, atol=1e-4)  # float32 over dt
    np.testing.assert_array_equal(belief[:, 4], agent.trials[0].actions[0, :30, 0])
    np.testing.assert_array_equal(data.actions[0, :, 0], agent.trials[0].actions[0, 1:30, 0])
    stage = SYSTEMS["cart-pole"].stage_cost(true[:30], agent.trials[0].actions[0])
    assert agent.history[0]["cost"] == pytest.approx(stage.sum()), "accounts go by the true state"


def test_trials_too_short_for_the_delays_are_left_out_or_told():
    agent = small(delays=4, trial_steps=3).learn
    with pytest.raises(
        ValueError, match="expected a trial of more than 3 steps to learn from, got 1 shorter ones"
    ):
        agent(1)


class Remembers:
    """A filter: b = (y, last action, steps so far)."""

    def initial_belief(self, n):
        return np.zeros((n, 5))

    def update(self, belief, observation, action):
        assert action.shape == (len(observation), 1)
        return np.concatenate([observation, action, belief[:, 4:] + 1.0], axis=1)


def test_a_filters_belief_is_the_state_the_same_when_learning_and_acting():
    agent = small(
        filter=Remembers(),
        cost=lambda x, u: (x[..., 0] - 1.0) ** 2 + 0.1 * x[..., 2] ** 2 + 0.01 * u[..., 0] ** 2,
        target=([1.0, 0.0, 0.0, 0.0, 0.0], [0.0]),
    )
    seen = []

    class Watches:
        def begin(self, n):
            return None

        def act(self, state, memory, restart):
            seen.append(state[0].copy())
            return np.full((len(state), 1), 0.1 * len(seen))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # a clock cannot be regulated
        agent.learn(1)
        agent._policies[-1] = Watches()
        agent._run_trial("policy")
    data = agent.dataset()
    assert data.n_obs == 5
    # recorded actions are float32
    np.testing.assert_allclose(data.observations[1, :12], np.array(seen), atol=1e-6)
    np.testing.assert_array_equal(data.observations[1, :, 4], np.arange(1.0, 14.0))
    np.testing.assert_array_equal(data.observations[1, :, :3], agent.trials[1].observations[0])
    np.testing.assert_allclose(data.observations[1, 1:, 3], data.actions[1, :, 0], atol=1e-6)


def test_a_new_episode_begins_with_the_filters_first_belief_and_no_action():
    agent = small(
        filter=Remembers(), cost=lambda x, u: (x**2).sum(-1) + u[..., 0] ** 2, target=(np.zeros(5), [0.5])
    )
    seen = np.array([[0.8, 0.6, 1.0], [1.0, 0.0, 2.0]])
    state = None
    for t in range(4):
        _, state = agent.predict(seen, state, np.array([t == 0, t in (0, 3)]))
    np.testing.assert_array_equal(state.belief, [[*seen[0], 0.5, 4.0], [*seen[1], 0.0, 1.0]])


@quiet
def test_a_cost_of_ones_own_serves_an_env_of_another_package():
    def cost(x, u):  # x, angle and their velocities, in MuJoCo's order
        return (
            x[..., 0] ** 2
            + 10.0 * x[..., 1] ** 2
            + 0.1 * (x[..., 2] ** 2 + x[..., 3] ** 2)
            + 0.01 * u[..., 0] ** 2
        )

    agent = SystemIdentification(
        "InvertedPendulum-v5",
        model=single_step(LinearRegression()),
        synthesis=RegulatorSynthesis(),
        cost=cost,
        initial_trials=6,
        trial_steps=80,
    )
    assert agent.coordinates.names == tuple(f"observation_{i}" for i in range(4))
    assert agent.dt == pytest.approx(0.04), "MuJoCo's own"
    np.testing.assert_allclose(agent.target[0], 0.0, atol=1e-6)
    agent.run_iterations(2)
    explored = [one["steps"] for one in agent.history if one["kind"] == "exploration"]
    assert max(explored) < 60, "at random it falls"
    assert agent.history[-1]["steps"] == 80, "and a linear model balances it"


@pytest.mark.parametrize(
    ("how", "error", "told"),
    [
        ({"model": Ridge()}, TypeError, r"expected model to be a DynamicsModel .*, got Ridge"),
        (
            {"initial_trials": -1},
            ValueError,
            "expected initial_trials to be a whole number of at least 0, got -1",
        ),
        (
            {"policy_trials": 0},
            ValueError,
            "expected policy_trials to be a whole number of at least 1, got 0",
        ),
        ({"exploration_trials": True}, ValueError, "expected exploration_trials to be a whole number"),
        ({"trial_steps": 0}, ValueError, "expected trial_steps of at least 1, or None, got 0"),
        ({"act_with": "worst"}, ValueError, "expected act_with to be 'best' or 'last', got 'worst'"),
        ({"delays": 0}, ValueError, "expected n_delays of at least 1"),
        ({"delays": 2, "filter": Remembers()}, ValueError, "expected delays=1 beside a filter"),
        ({"filter": Remembers()}, ValueError, "with a filter: a belief has no named state"),
        (
            {"target": ([0.0], [0.0])},
            ValueError,
            r"expected target as \(2,\) and \(1,\), got \(1,\) and \(1,\)",
        ),
        (
            {"env": "Pendulum-v1"},
            ValueError,
            r"expected cost=function.* for Pendulum-v1: it has no beliefgym system",
        ),
        ({"env": "beliefgym/PendulumPosition-v0"}, ValueError, r"\['angular_velocity'\] is not there"),
        ({"env": "beliefgym/CartPoleBalance-v0"}, ValueError, "SystemIdentification needs a flat Box space"),
    ],
    ids=lambda one: ", ".join(one) if isinstance(one, dict) else getattr(one, "__name__", str(one)),
)
def test_what_cannot_work_is_told(how, error, told):
    with pytest.raises(error, match=told):
        small(**how)


def test_unbounded_actions_are_refused():
    class Free(gym.Env):
        observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
        action_space = gym.spaces.Box(-np.inf, np.inf, (1,))

    gym.register("beliefgym-tests/Free-v0", entry_point=Free)
    try:
        with pytest.raises(ValueError, match="SystemIdentification needs bounded actions, got Box"):
            small("beliefgym-tests/Free-v0", cost=lambda x, u: (x**2).sum(-1))
    finally:
        del gym.registry["beliefgym-tests/Free-v0"]


def test_no_initial_trials_warns_and_runs_one_all_the_same():
    with pytest.warns(ModelWarning, match="initial_trials=0 gives no exploration data"):
        agent = small(initial_trials=0)
    agent.run_iterations(1)
    assert [one["kind"] for one in agent.history] == ["exploration", "policy"]


def test_the_expert_explores_and_epsilon_disturbs_the_policy():
    expert = small(CART_POLE, exploration=Exploration("expert")).learn(1)
    theirs = Expert(CART_POLE)
    env = gym.make(CART_POLE)
    theirs.set_env(env)
    seed = int(np.random.SeedSequence([3, 0]).generate_state(1)[0])
    trial = collect(env, theirs, 1, seed, max_steps_per_episode=12)
    np.testing.assert_array_equal(expert.trials[0].actions, trial.actions)
    followed = small(exploration=Exploration("epsilon", epsilon=0.0), exploration_trials=1).run_iterations(1)
    followed.learn(1)  # the iteration's exploration trial: the policy, never disturbed
    assert followed.history[2]["kind"] == "exploration"
    trial = followed.trials[2]
    state = None
    for t in range(12):
        y = trial.observations[0, t].astype(np.float32)
        action, state = followed.act(followed._policies[0], y, state, np.array([t == 0]))
        np.testing.assert_allclose(trial.actions[0, t], action, atol=1e-6)  # float32
