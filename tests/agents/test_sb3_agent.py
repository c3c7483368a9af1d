"""SB3's algorithms in our face: the same training, the same actions, one file."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from beliefgym.agents import SB3Agent, evaluate, load_agent, make_agent
from beliefgym.wrappers import SB3VecEnv, Task

TASK = Task("beliefgym/PendulumPosition-v0", {}, (("ActionHistory", {"length": 1}),))
SMALL = {"policy": "MlpPolicy", "n_steps": 32, "batch_size": 32, "n_epochs": 2}


def roll(predict, task, n=4, steps=25):
    """Observations seen by a policy through its state, over an episode's start in the middle."""
    env = task.make_vec(n)
    observation, _ = env.reset(seed=5)
    state, start, actions = None, np.ones(n, dtype=bool), []
    for t in range(steps):
        if t == 11:
            start = np.array([True] + [False] * (n - 1))
        action, state = predict(observation, state=state, episode_start=start, deterministic=True)
        observation, *_ = env.step(action)
        start = np.zeros(n, dtype=bool)
        actions.append(action)
    return np.array(actions)


def test_training_is_sb3s_own_training():
    agent = SB3Agent(TASK, seed=3, algorithm="PPO", n_envs=4, n_stack=3, normalize=True, arguments=SMALL)
    agent.learn(256)
    env = VecFrameStack(VecNormalize(SB3VecEnv(TASK.make_vec(4)), gamma=0.99), 3)
    model = PPO(env=env, seed=3, device="cpu", **SMALL)
    model.learn(256)
    for name, weights in model.policy.state_dict().items():
        assert np.array_equal(agent.model.policy.state_dict()[name].numpy(), weights.numpy()), name


def test_predict_does_to_raw_observations_what_sb3s_wrappers_do():
    """The agent's memory of frames against VecNormalize and VecFrameStack around the same environment."""
    agent = SB3Agent(TASK, seed=0, algorithm="PPO", n_envs=4, n_stack=3, normalize=True, arguments=SMALL)
    agent.learn(256)
    wrapped = agent.model.get_env()
    assert isinstance(wrapped, VecFrameStack)
    wrapped.venv.training = False
    wrapped.seed(7)
    stacked = wrapped.reset()
    env = TASK.make_vec(4)
    observation, _ = env.reset(seed=7)
    state = None
    for t in range(250):  # over the end of the episodes at 200 steps
        theirs, _ = agent.model.predict(stacked, deterministic=True)
        starts = np.full(4, t in (0, 200))
        ours, state = agent.predict(observation, state=state, episode_start=starts, deterministic=True)
        assert ours == pytest.approx(theirs, abs=1e-6), t  # float32
        stacked, *_ = wrapped.step(theirs)
        observation, *_ = env.step(theirs)


@pytest.mark.parametrize(
    "options",
    [
        {
            "algorithm": "PPO",
            "n_envs": 2,
            "n_stack": 2,
            "normalize": True,
            "rescale_actions": True,
            "arguments": SMALL,
        },
        {"algorithm": "SAC", "arguments": {"policy": "MlpPolicy", "learning_starts": 10, "buffer_size": 500}},
        {"algorithm": "RecurrentPPO", "n_envs": 2, "arguments": {**SMALL, "policy": "MlpLstmPolicy"}},
    ],
    ids=["ppo", "sac", "recurrent"],
)
def test_a_saved_agent_acts_and_goes_on_learning(options, tmp_path):
    agent = SB3Agent(TASK, seed=1, **options)
    agent.registered_name = "mine"
    agent.learn(64)
    agent.save(tmp_path / "agent")
    again = load_agent(tmp_path / "agent.zip")
    assert again.registered_name == "mine"
    assert again.task == TASK
    assert np.array_equal(roll(agent.predict, TASK), roll(again.predict, TASK))
    before = again.model.num_timesteps
    again.learn(64)
    assert again.model.num_timesteps > before


def test_sb3s_evaluate_policy_and_ours_agree():
    agent = make_agent("recurrent-ppo", TASK.env_id, seed=0, n_envs=2)
    ours = evaluate(agent, TASK.env_id, n_episodes=3, seed=4)
    env = Task(TASK.env_id).make()
    theirs = []
    for episode in range(3):
        env.reset(seed=4 + episode)
        start = env.unwrapped.state
        theirs += evaluate_policy(
            agent, _StartAt(env, start), n_eval_episodes=1, return_episode_rewards=True, warn=False
        )[0]
    assert ours.returns == pytest.approx(theirs, rel=1e-5)
    assert ours.lengths.tolist() == [200, 200, 200]


class _StartAt(gym.Wrapper):
    """Every reset goes to one state, so that SB3's own resets do not matter."""

    def __init__(self, env, state):
        super().__init__(env)
        self._state = state

    def reset(self, *, seed=None, options=None):
        return self.env.reset(options={"state": self._state})


def test_one_observation_alone_is_as_good_as_a_batch():
    agent = SB3Agent(TASK, algorithm="PPO", n_stack=2, arguments=SMALL)
    env = TASK.make()
    observation, _ = env.reset(seed=0)
    single, state = agent.predict(observation, deterministic=True)
    batch, _ = agent.predict(observation[None], deterministic=True)
    assert single.shape == env.action_space.shape
    assert np.array_equal(single, batch[0])
    agent.predict(observation, state=state, deterministic=True)
    with pytest.raises(
        ValueError, match=r"expected an observation of shape \(3,\), or a batch .* got \(5,\)"
    ):
        agent.predict(np.zeros(5))


def test_rescaled_actions_fill_the_box():
    agent = SB3Agent("beliefgym/CartPoleSwingUp-v0", algorithm="PPO", rescale_actions=True, arguments=SMALL)
    assert agent.model.action_space.high.tolist() == [1.0]
    env = agent.task.make_vec(64)
    action, _ = agent.predict(env.reset(seed=0)[0], deterministic=False)
    assert np.abs(action).max() > 5.0
    assert np.abs(action).max() <= 10.0


def test_tensorboard_in_sb3s_layout(tmp_path):
    pytest.importorskip("tensorboard", reason="the tensorboard extra is not installed")
    agent = make_agent("ppo", TASK.env_id, tensorboard_log=str(tmp_path), n_envs=2, arguments=SMALL)
    agent.learn(128)
    assert list(tmp_path.glob("ppo_1/events.out.tfevents.*"))


def test_a_checkpoint_for_another_observation_space_is_told(tmp_path):
    agent = SB3Agent(TASK, algorithm="PPO", arguments=SMALL)
    agent.save(tmp_path / "agent.zip")
    with pytest.raises(
        ValueError, match=r"agent.zip was trained on .* observation space Box.*\(3,\).* has Box"
    ):
        load_agent(tmp_path / "agent.zip", "beliefgym/CartPoleSwingUp-v0")
    weaker = Task(TASK.env_id, {"max_torque": 1.0})
    SB3Agent(TASK.env_id, algorithm="PPO", arguments=SMALL).save(tmp_path / "strong.zip")
    with pytest.raises(
        ValueError, match=r"strong.zip was trained .* action space Box\(-2.*, but .* has Box\(-1"
    ):
        load_agent(tmp_path / "strong.zip", weaker)
    assert load_agent(tmp_path / "agent.zip", TASK).task == TASK


def test_files_that_are_no_agents_are_told(tmp_path):
    (tmp_path / "text.zip").write_text("not a zip")
    with pytest.raises(ValueError, match="text.zip is not a saved beliefgym agent"):
        load_agent(tmp_path / "text.zip")
    agent = SB3Agent(TASK, algorithm="PPO", arguments=SMALL)
    agent.model.save(tmp_path / "sb3.zip")
    with pytest.raises(ValueError, match="sb3.zip is not a saved beliefgym agent"):
        load_agent(tmp_path / "sb3.zip")
    with pytest.raises(FileNotFoundError, match="no saved agent at .*none"):
        load_agent(tmp_path / "none.zip")


def test_impossible_options_are_told():
    with pytest.raises(ValueError, match="algorithm to be one of PPO, .* got 'PP0'"):
        SB3Agent(TASK, algorithm="PP0")
    discrete = Task(TASK.env_id, {}, (("DiscreteActions", {"bins": 3}),))
    with pytest.raises(ValueError, match="rescale_actions needs a flat Box space"):
        SB3Agent(discrete, algorithm="PPO", rescale_actions=True, arguments=SMALL)
    with pytest.raises(TypeError, match="agent 'ppo': .*unexpected keyword argument 'n_stak'.*n_envs"):
        make_agent("ppo", TASK, n_stak=3)
