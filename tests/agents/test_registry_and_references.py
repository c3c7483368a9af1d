"""Random, expert, registry, evaluation and reference scores."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from beliefgym.agents import (
    Agent,
    AgentSpec,
    Expert,
    RandomAgent,
    agent_specs,
    evaluate,
    find_agent,
    make_agent,
    register_agent,
)
from beliefgym.agents.references import _table, _what_decides_returns, measure, references
from beliefgym.envs import registered_ids
from beliefgym.wrappers import SB3VecEnv, Task


class Pusher(Agent):
    """An agent of the user's own: a constant action."""

    def __init__(self, task, seed=0, force=1.0):
        super().__init__(task, seed)
        self.force = force

    def learn(self, total_timesteps, callback=None, progress_bar=False):
        return self

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        observation, single = self.batched(observation)
        action = np.full((len(observation), 1), self.force, dtype=np.float32)
        return (action[0] if single else action), None

    def options(self):
        return {"force": self.force}

    def parts(self):
        return {}

    def restore(self, parts):
        pass


@pytest.mark.parametrize("env_id", registered_ids())
def test_the_reference_agents_act_in_every_environment(env_id):
    """A trained one is built for one id of each kind below; the expert and the random policy for all."""
    for name in ("random", "expert") if "DoublePendulum" not in env_id else ("random",):
        _act_once(name, env_id)


MODEL_BASED = ("dad-control", "dagger-control", "pets")


@pytest.mark.parametrize("name", MODEL_BASED)
def test_the_model_based_agents_act_where_the_cost_can_be_read_off_what_is_shown(name):
    _act_once(name, "beliefgym/CartPoleSwingUp-v0")
    if name != "pets":
        _act_once(name, "beliefgym/PendulumPosition-v0")  # by two observations
        _act_once(name, "beliefgym/HelicopterHover-v0")
    with pytest.raises(ValueError, match=r"expected .*MicoLift.*; give a cost"):
        make_agent(name, "beliefgym/MicoLiftTorque-v0")
    with pytest.raises(ValueError, match=r"cost=.* for .*HopperPosition|got HopperPosition.*; give a cost"):
        make_agent(name, "beliefgym/HopperPosition-v0")


@pytest.mark.parametrize("name", [name for name in agent_specs() if name not in (*MODEL_BASED, "dqn-stack")])
@pytest.mark.parametrize(
    "env_id",
    [
        "PendulumPosition",
        "HelicopterHoverDelayed",
        "QuadrotorHoverIMUNoisy",
        "MicoLiftTorque",
        "HopperPosition",
    ],
)
def test_every_registered_agent_builds_and_acts(name, env_id):
    knows = name.endswith("-known") or name == "filter-expert"
    if knows and env_id == "HopperPosition":  # Gymnasium's simulation: no system to know
        with pytest.raises(ValueError, match=r"expected a task of a beliefgym system.* got HopperPosition"):
            make_agent(name, f"beliefgym/{env_id}-v0")
    else:
        _act_once(name, f"beliefgym/{env_id}-v0")


def _act_once(name, env_id):
    agent = make_agent(name, env_id, seed=0)
    env = Task(env_id).make_vec(3)
    agent.set_env(env)
    observation, _ = env.reset(seed=0)
    action, _ = agent.predict(observation, deterministic=True)
    assert action.shape == env.action_space.shape
    env.step(action)


def test_an_action_space_that_an_algorithm_cannot_act_in_is_told():
    _act_once("ppo", "beliefgym/CartPoleBalancePosition-v0")
    _act_once("recurrent-ppo", "beliefgym/CartPoleBalanceNoisyHard-v0")
    with pytest.raises(
        ValueError, match=r"SAC acts in a Box .* CartPoleBalance-v0 has Discrete\(2\); take PPO"
    ):
        make_agent("sac", "beliefgym/CartPoleBalance-v0")
    _act_once("dqn-stack", "beliefgym/CartPoleBalancePosition-v0")
    with pytest.raises(
        ValueError, match=r"DQN chooses among finitely many .*PendulumPosition-v0 has Box.*bins"
    ):
        make_agent("dqn-stack", "beliefgym/PendulumPosition-v0")


def test_evaluation_sums_whole_episodes_of_their_own_seeds():
    task = Task("beliefgym/CartPoleSwingUp-v0")
    agent = Pusher(task, force=6.0)
    result = evaluate(agent, task, n_episodes=5, seed=20)
    env = task.make()
    for episode in range(5):
        observation, _ = env.reset(seed=20 + episode)
        total, steps, done = 0.0, 0, False
        while not done:
            action, _ = agent.predict(observation)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, steps, done = total + reward, steps + 1, terminated or truncated
        assert result.returns[episode] == pytest.approx(total, abs=1e-9)
        assert result.lengths[episode] == steps
    assert result.lengths.max() < 200  # pushed off the track
    assert result.mean == pytest.approx(result.returns.mean())
    assert result.standard_error == pytest.approx(result.returns.std(ddof=1) / np.sqrt(5))


def test_evaluation_never_cuts_silently():
    with pytest.raises(RuntimeError, match="2 of 2 episodes .* did not end within 50 steps"):
        evaluate(RandomAgent("beliefgym/Pendulum-v0"), "beliefgym/Pendulum-v0", 2, max_steps=50)
    with pytest.raises(ValueError, match="at least 1 episode, got 0"):
        evaluate(RandomAgent("beliefgym/Pendulum-v0"), "beliefgym/Pendulum-v0", 0)


def test_evaluation_on_a_foreign_environment():
    result = evaluate(RandomAgent("CartPole-v1", seed=1), "CartPole-v1", 20, seed=0)
    assert result.returns == pytest.approx(result.lengths)  # one a step
    assert 10 < result.mean < 40


def test_the_random_agent_is_seeded_and_uniform():
    task = "beliefgym/Pendulum-v0"
    draws = [RandomAgent(task, seed=seed).predict(np.zeros((5000, 3)))[0] for seed in (0, 0, 1)]
    assert np.array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2])
    assert draws[0].std() == pytest.approx(4 / np.sqrt(12), rel=0.05)


def test_the_expert_reads_the_state_of_whatever_environment_it_acts_in():
    task = Task("beliefgym/PendulumPosition-v0")
    expert = Expert(task)
    env = task.make()
    with pytest.raises(RuntimeError, match=r"call set_env\(env\)"):
        expert.predict(env.reset(seed=0)[0])
    vector = task.make_vec(2)
    sb3 = SB3VecEnv(task.make_vec(2))
    for environment in (env, vector, sb3, DummyVecEnv([lambda: env])):
        expert.set_env(environment)
        if environment is env or environment is vector:
            observation, _ = environment.reset(seed=1)
        else:
            environment.seed(1)
            observation = environment.reset()
        action, _ = expert.predict(observation)
        low, high = expert.system.action_limits
        assert ((action >= low) & (action <= high)).all()
    expert.set_env(env)
    mean, _ = evaluate_policy(expert, env, n_eval_episodes=2, warn=False)
    assert mean > -600
    expert.set_env(vector)
    with pytest.raises(ValueError, match="2 copies, the observation 3"):
        expert.predict(np.zeros((3, 2)))
    with pytest.raises(TypeError, match="expected an environment, got str"):
        expert.set_env("beliefgym/Pendulum-v0")


def test_the_expert_acts_through_discrete_actions():
    task = Task(
        "beliefgym/Pendulum-v0", {}, (("DiscreteActions", {"bins": 9}), ("ActionHistory", {"length": 1}))
    )
    result = evaluate(make_agent("expert", task), task, 20, seed=0)
    continuous = evaluate(make_agent("expert", "beliefgym/Pendulum-v0"), "beliefgym/Pendulum-v0", 20, seed=0)
    assert result.mean == pytest.approx(continuous.mean, abs=40)


def test_there_is_no_expert_for_a_foreign_environment():
    with pytest.raises(ValueError, match="Hopper-v5 has no expert"):
        Expert("Hopper-v5")


def test_references_set_the_scale():
    scale = references("beliefgym/PendulumPosition-v0")
    assert scale.score(scale.random) == pytest.approx(0.0)
    assert scale.score(scale.expert) == pytest.approx(1.0)
    # a wrapper that changes only the observation leaves them; other physics are measured anew
    noisy = Task("beliefgym/PendulumPosition-v0", {}, (("ObservationNoise", {"std": 0.1}),))
    assert references(noisy) == scale
    other = references(Task("beliefgym/Pendulum-v0", {"max_torque": 4.0}), n_episodes=50)
    assert other.expert > scale.expert


SLOW = (
    "DoublePendulum",
    "HelicopterCompetition",
    "Baxter",
    "Mico",
    "Hopper",
    "Walker2d",
    "HalfCheetah",
    "Swimmer",
)


def _one_id_for_each_physics():
    """Ids that differ in what they show have the same references."""
    found = {_what_decides_returns(env_id): env_id for env_id in reversed(registered_ids())}
    for env_id in found.values():
        slow = env_id.rpartition("/")[2].startswith(SLOW)
        yield pytest.param(env_id, marks=[pytest.mark.slow] if slow else [])


@pytest.mark.parametrize("env_id", list(_one_id_for_each_physics()))
def test_committed_references_are_what_is_measured(env_id):
    n = 50 if hasattr(gym.make(env_id).unwrapped, "expert_kind") else 200  # Gymnasium's own tasks are slow
    kept, found = references(env_id), measure(env_id, n)
    for name in ("random", "expert"):
        error = 4 * np.hypot(
            getattr(kept, f"{name}_standard_error"), getattr(found, f"{name}_standard_error")
        )
        # 1e-3: a plan's last digits differ between machines
        assert getattr(found, name) == pytest.approx(getattr(kept, name), abs=error + 1e-6, rel=1e-3)


def test_every_id_has_its_references_in_the_package():
    assert sorted(_table()) == registered_ids()


def test_agents_of_the_users_own_join():
    agent = make_agent(f"{__name__}:Pusher", "beliefgym/Pendulum-v0", force=0.5)
    assert agent.predict(np.zeros(3))[0].tolist() == [0.5]
    register_agent(AgentSpec("pusher", f"{__name__}:Pusher", "pushes"))
    register_agent(AgentSpec("pusher", f"{__name__}:Pusher", "pushes"))  # the same again is no clash
    assert make_agent("pusher", "beliefgym/Pendulum-v0").registered_name == "pusher"
    with pytest.raises(ValueError, match="there is an agent 'pusher' already"):
        register_agent(AgentSpec("pusher", "other:Thing", ""))


def test_unknown_agents_are_told_with_the_nearest():
    with pytest.raises(ValueError, match="no agent 'sac-stak'; did you mean 'sac-stack'"):
        find_agent("sac-stak")
    with pytest.raises(ValueError, match="cannot load the agent 'nowhere:Thing'"):
        make_agent("nowhere:Thing", "beliefgym/Pendulum-v0")


def test_entry_points_are_found(monkeypatch):
    from importlib.metadata import EntryPoint

    import beliefgym.agents.registry as registry

    point = EntryPoint("visitor", f"{__name__}:Pusher", registry.GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == registry.GROUP else [])
    assert isinstance(make_agent("visitor", "beliefgym/Pendulum-v0"), Pusher)
    assert gym
