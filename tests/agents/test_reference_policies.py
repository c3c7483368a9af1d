"""Trained full-state policies: the numpy network is SB3's policy, training goes on where it stopped."""

import json

import gymnasium as gym
import numpy as np
import pytest

from beliefgym.agents import SB3Agent, evaluate, make_agent
from beliefgym.agents.reference_policies import RECIPES, VALIDATION_EPISODES, policy_of, train_reference
from beliefgym.agents.references import references
from beliefgym.envs.locomotion import TASKS
from beliefgym.envs.reference_policies import MLPPolicy, load_policy, reference_policy

SMALL = {"policy": "MlpPolicy", "n_steps": 64, "batch_size": 64, "n_epochs": 2}


def observations(agent, n=500, seed=0):
    """Half as they come, half far out, where the normalisation clips."""
    rng = np.random.default_rng(seed)
    near = rng.normal(size=(n, *agent.observation_space.shape))
    return np.where(np.arange(n)[:, None] % 2, near, 50.0 * near)


@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("normalize", [True, False])
def test_the_numpy_network_gives_sb3s_deterministic_action(activation, normalize, tmp_path):
    arguments = {
        **SMALL,
        "learning_rate": 1e-2,
        "policy_kwargs": {"activation_fn": activation, "net_arch": {"pi": [32, 16], "vf": [8]}},
    }
    agent = SB3Agent("Hopper-v5", seed=1, n_envs=2, normalize=normalize, arguments=arguments).learn(256)
    agent.model.policy.action_net.bias.data[0] = 1.5  # beyond the bounds
    policy = policy_of(agent, {"name": "tiny"})
    seen = observations(agent)
    expected, _ = agent.predict(seen, deterministic=True)
    assert (expected == 1.0).any()  # clipped ones among them
    assert (np.abs(expected) < 1.0).any()
    # single precision, and sums in another order than torch's
    assert policy(seen) == pytest.approx(expected, abs=2e-6)
    assert policy(seen).dtype == np.float32
    policy.save(tmp_path / "tiny")
    again = load_policy(tmp_path / "tiny")
    assert np.array_equal(again(seen), policy(seen))
    assert again.about == {"name": "tiny"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiny.json", "tiny.safetensors"]


def test_agents_that_are_no_plain_network_are_told():
    stacked = SB3Agent("Hopper-v5", n_stack=2, arguments=SMALL)
    with pytest.raises(ValueError, match=r"without stacked frames .* got PPO \(n_stack=2"):
        policy_of(stacked)
    with pytest.raises(ValueError, match="got SAC"):
        policy_of(
            SB3Agent("Hopper-v5", algorithm="SAC", arguments={"policy": "MlpPolicy", "buffer_size": 10})
        )


def test_files_that_do_not_fit_are_told(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no policy file .*nobody\.json"):
        load_policy(tmp_path / "nobody")
    layer = (np.zeros((2, 3), np.float32),), (np.zeros(2, np.float32),)
    bounds = -np.ones(2, np.float32), np.ones(2, np.float32)
    moments = np.zeros(3), np.ones(3)
    policy = MLPPolicy(*layer, "relu", *bounds, *moments)
    with pytest.raises(
        ValueError, match=r"layers do not fit together: weights \[\(2, 3\)\], expected \[\(2, 4\)\]"
    ):
        MLPPolicy(*layer, "relu", *bounds, np.zeros(4), np.ones(4))
    with pytest.raises(ValueError, match="expected activation to be one of relu, tanh, got 'gelu'"):
        MLPPolicy(*layer, "gelu", *bounds, *moments)
    policy.save(tmp_path / "old")
    header = json.loads((tmp_path / "old.json").read_text())
    (tmp_path / "old.json").write_text(json.dumps({**header, "format": 99}))
    with pytest.raises(ValueError, match="expected format 1, got 99"):
        load_policy(tmp_path / "old")


def test_training_keeps_the_best_and_goes_on_where_it_stopped(tmp_path):
    told = []
    best = train_reference("InvertedPendulum", tmp_path, steps=1024, every=512, told=told.append)
    curve = json.loads((tmp_path / "InvertedPendulum.curve.json").read_text())
    assert [point["steps"] for point in curve] == [512, 1024]
    top = max(curve, key=lambda point: point["mean_return"])
    assert best.about["steps"] == top["steps"]
    assert best.about["validation"]["mean_return"] == top["mean_return"]
    assert best.about["arguments"] == dict(RECIPES["InvertedPendulum"].arguments)
    again = train_reference("InvertedPendulum", tmp_path, steps=1536, every=512, told=told.append)
    assert told[2] == "InvertedPendulum: going on from step 1024"
    curve = json.loads((tmp_path / "InvertedPendulum.curve.json").read_text())
    assert [point["steps"] for point in curve] == [512, 1024, 1536]
    assert again.about["validation"]["mean_return"] == max(point["mean_return"] for point in curve)
    # what is kept on file does what it is said to
    env = gym.make_vec("InvertedPendulum-v5", VALIDATION_EPISODES, vectorization_mode="sync")
    observation, _ = env.reset(seed=3_000_000)
    running = np.ones(VALIDATION_EPISODES, dtype=bool)
    total = np.zeros(VALIDATION_EPISODES)
    while running.any():
        observation, reward, terminated, truncated, _ = env.step(again(observation))
        total += reward * running
        running &= ~(terminated | truncated)
    assert total.mean() == pytest.approx(again.about["validation"]["mean_return"], abs=0.5)
    with pytest.raises(ValueError, match="there is no recipe 'Ant'; known: HalfCheetah"):
        train_reference("Ant", tmp_path)


def test_every_locomotion_task_has_a_recipe_and_a_policy():
    assert set(RECIPES) == set(TASKS)
    for name, recipe in RECIPES.items():
        policy = reference_policy(name)
        about = policy.about
        assert about["arguments"] == json.loads(json.dumps(dict(recipe.arguments)))
        assert (about["n_envs"], about["seed"], about["env_id"]) == (
            recipe.n_envs,
            recipe.seed,
            recipe.env_id,
        )
        assert about["steps"] <= recipe.steps
        assert policy.variance.min() > 0


# measured at the time of training, less a margin for other versions of MuJoCo: see each policy's JSON
FLOORS = {"HalfCheetah": 5500, "Walker2d": 4500, "Hopper": 3000, "Swimmer": 320, "InvertedPendulum": 990}


@pytest.mark.parametrize("name", FLOORS)
def test_the_expert_of_a_locomotion_task_is_much_better_than_chance(name):
    env_id = f"beliefgym/{name}Position-v0"
    result = evaluate(make_agent("expert", env_id), env_id, 10, seed=77)
    assert result.mean > FLOORS[name]
    scale = references(env_id)
    assert scale.score(result.mean) == pytest.approx(1.0, abs=0.4)
    assert scale.random < 0.1 * scale.expert
