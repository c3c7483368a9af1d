"""SB3's algorithms in our face: the same training, the same actions, one file."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from sb3_contrib import TQC, CrossQ
from scipy.integrate import trapezoid
from scipy.special import softmax
from scipy.stats import chisquare, kstest, norm
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from beliefgym.agents import RandomAgent, SB3Agent, evaluate, load_agent, make_agent, with_log_probs
from beliefgym.envs import EpsilonPolicy, GaussianPolicy, collect
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
    with pytest.raises(ValueError, match="DQN chooses among finitely many .*put DiscreteActions around it"):
        SB3Agent(TASK, algorithm="DQN", arguments=OFF_POLICY)
    discrete = Task(TASK.env_id, {}, (("DiscreteActions", {"bins": 3}),))
    with pytest.raises(ValueError, match="rescale_actions needs a flat Box space"):
        SB3Agent(discrete, algorithm="PPO", rescale_actions=True, arguments=SMALL)
    with pytest.raises(TypeError, match="agent 'ppo': .*unexpected keyword argument 'n_stak'.*n_envs"):
        make_agent("ppo", TASK, n_stak=3)


CHOICES = Task("beliefgym/PendulumPosition-v0", {}, (("DiscreteActions", {"bins": 3}),))
OFF_POLICY = {"policy": "MlpPolicy", "learning_starts": 10, "buffer_size": 500}


def first_observations(task, n=200):
    return task.make_vec(n).reset(seed=0)[0]


def with_seed(seed, function, *arguments, **named):
    torch.manual_seed(seed)
    return function(*arguments, **named)


@pytest.mark.parametrize("sde", [False, True])
@pytest.mark.parametrize("rescale", [False, True])
def test_the_density_of_gaussian_actions_is_in_the_environments_units(rescale, sde):
    """Against scipy's normal density with mean and std stretched as the box of -10..10 is."""
    arguments = {**SMALL, "use_sde": sde}
    agent = SB3Agent(
        "beliefgym/CartPoleSwingUp-v0", algorithm="PPO", rescale_actions=rescale, arguments=arguments
    )
    observation = first_observations(agent.task)
    action, _, log_prob = agent.predict_with_log_prob(observation)
    policy = agent.model.policy
    with torch.no_grad():
        normal = policy.get_distribution(policy.obs_to_tensor(observation)[0]).distribution
    stretch = 10.0 if rescale else 1.0
    mean, std = (stretch * x.double().numpy() for x in (normal.loc, normal.scale))
    # actions are rounded to float32, and so are mean and std
    np.testing.assert_allclose(log_prob, norm.logpdf(action, mean, std).sum(axis=1), atol=1e-5)
    z = ((action - mean) / std)[:, 0]
    assert kstest(z, "norm").pvalue > 1e-3  # a fixed seed; rows are independent, under gSDE too
    if rescale and not sde:
        assert (np.abs(action) > 10.0).any()  # not clipped


def test_gsde_actions_have_the_marginal_density_of_sb3():
    """SB3's own log_prob; and, beside it, noise that is new in every call, with the policy's matrix left alone."""
    agent = SB3Agent(TASK, algorithm="PPO", arguments={**SMALL, "use_sde": True})
    observation = first_observations(TASK, 1)
    policy = agent.model.policy
    matrix = policy.action_dist.exploration_mat.clone()
    drawn = [agent.predict_with_log_prob(observation) for _ in range(500)]
    action = torch.tensor(np.concatenate([a for a, _, _ in drawn]))
    with torch.no_grad():
        shown = policy.obs_to_tensor(np.repeat(observation, 500, axis=0))[0]
        theirs = policy.evaluate_actions(shown, action)[1].numpy()
        std = policy.get_distribution(shown).distribution.scale[0].item()
    assert np.concatenate([p for _, _, p in drawn]) == pytest.approx(theirs, abs=1e-5)  # float32
    assert action.std().item() == pytest.approx(std, rel=0.13)  # 4 standard errors of a std from 500 draws
    assert torch.equal(policy.action_dist.exploration_mat, matrix)


class Lopsided(gym.Env):
    """A box of different and asymmetric widths, or another action space; observations are noise."""

    observation_space = Box(-np.inf, np.inf, (3,), np.float32)

    def __init__(self, action_space=None):
        self.action_space = action_space or Box(
            np.array([-1.0, 2.0], np.float32), np.array([3.0, 2.5], np.float32)
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.normal(size=3).astype(np.float32), {}

    def step(self, action):
        return self.np_random.normal(size=3).astype(np.float32), 0.0, False, True, {}


@pytest.mark.parametrize("sde", [False, True])
@pytest.mark.parametrize("algorithm", [SAC, TQC, CrossQ])
def test_the_density_of_squashed_actions_integrates_to_one_over_the_box(algorithm, sde):
    """The change of variables anew: p(a) = N(arctanh y) / (1 - y^2) / (half width), y = a mapped to -1..1."""
    model = algorithm(
        env=Lopsided(),
        seed=0,
        device="cpu",
        use_sde=sde,
        policy_kwargs={"log_std_init": -1.0} if sde else {},
        **OFF_POLICY,
    )
    low, high = model.action_space.low.astype(float), model.action_space.high.astype(float)
    observation = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    action, _, log_prob = with_log_probs(model).predict_with_log_prob(observation)
    actor = model.policy.actor
    with torch.no_grad():
        mean, log_std, extra = actor.get_action_dist_params(torch.tensor(observation))
        actor.action_dist.proba_distribution(mean, log_std, **extra)
    normal = actor.action_dist.distribution
    mean, std = normal.loc.double().numpy(), normal.scale.double().numpy()

    def density(a, i):
        """(points, 2) of each component, of row i."""
        y = 2.0 * (a - low) / (high - low) - 1.0
        return norm.pdf(np.arctanh(y), mean[i], std[i]) / (1.0 - y**2) / (0.5 * (high - low))

    grid = low + (high - low) * (0.5 + 0.5 * np.tanh(np.linspace(-8.0, 8.0, 4001)[:, None]))
    assert trapezoid(density(grid, 0), grid, axis=0) == pytest.approx(1.0, abs=1e-5)
    assert ((action > low) & (action < high)).all()
    # The action is float32: near a bound, 1 - y^2 = 0.01 is known to 1e-5.
    inner = (np.abs(2.0 * (action - low) / (high - low) - 1.0) < 0.995).all(axis=1)
    assert inner.mean() > 0.9
    expected = np.log(np.prod(density(action.astype(float), slice(None)), axis=1))
    np.testing.assert_allclose(log_prob[inner], expected[inner], atol=2e-3)
    # the weights of the uniform policy, whose variance is bounded for std >= 0.7 alone
    if not sde:
        weight = np.exp(-log_prob) / np.prod(high - low)
        assert abs(weight.mean() - 1.0) < 4 * weight.std() / np.sqrt(len(weight))


@pytest.mark.parametrize("rescale", [False, True])
def test_the_density_of_sac_as_an_agent(rescale):
    """Weights of the uniform policy on -10..10, whether SAC or the agent stretches the actions."""
    agent = SB3Agent(
        "beliefgym/CartPoleSwingUp-v0", algorithm="SAC", rescale_actions=rescale, arguments=OFF_POLICY
    )
    action, _, log_prob = agent.predict_with_log_prob(first_observations(agent.task, 4000))
    assert action.dtype == np.float32
    assert np.abs(action).max() > 9.0
    weight = np.exp(-log_prob) / 20.0
    assert abs(weight.mean() - 1.0) < 4 * weight.std() / np.sqrt(4000)
    assert weight.std() < 2.0  # so that the check is one


def test_a_saturated_action_has_a_finite_density():
    """Where tanh rounds to 1 the density is that before rounding, not that of SB3's 1 - tanh^2 + 1e-6."""
    model = SAC(env=Lopsided(), seed=0, device="cpu", **OFF_POLICY)
    with torch.no_grad():
        model.policy.actor.mu.bias.fill_(12.0)
        model.policy.actor.log_std.weight.zero_()
        model.policy.actor.log_std.bias.fill_(-3.0)
    action, _, log_prob = with_log_probs(model).predict_with_log_prob(np.zeros((5, 3), np.float32))
    assert (action == model.action_space.high).all()
    # log N(u) is at most 4.2 for both, log(1 - tanh^2 u) near 2 (log 2 - 12) for each, log half widths 0.69 and -1.39
    at_most = 2 * (3.0 - 0.5 * np.log(2 * np.pi)) + 4 * (12.0 - np.log(2.0)) + 0.7
    assert (np.abs(log_prob - at_most) < 8.0).all()
    assert (log_prob > 2 * np.log(1e6) + 10).all()  # which SB3's constant would not let through


def test_the_probabilities_of_choices():
    agent = SB3Agent(CHOICES, algorithm="PPO", arguments=SMALL)
    with torch.no_grad():
        agent.model.policy.action_net.bias += torch.tensor([0.0, 1.0, -1.0])
    observation = np.repeat(first_observations(CHOICES, 1), 5000, axis=0)
    action, _, log_prob = agent.predict_with_log_prob(observation)
    policy = agent.model.policy
    with torch.no_grad():
        logits = policy.get_distribution(policy.obs_to_tensor(observation[:1])[0]).distribution.logits
    p = softmax(logits.double().numpy()[0])
    np.testing.assert_allclose(np.exp(log_prob), p[action], rtol=1e-5)  # float32
    assert chisquare(np.bincount(action, minlength=3), 5000 * p).pvalue > 1e-3


@pytest.mark.parametrize("space", [Discrete(3), MultiDiscrete([2, 3]), MultiBinary(2)], ids=str)
def test_the_probabilities_of_every_kind_of_choice(space):
    """Frequencies of the combinations drawn for one observation against the probabilities told."""
    model = PPO(env=Lopsided(space), seed=0, device="cpu", **SMALL)
    action, _, log_prob = with_log_probs(model).predict_with_log_prob(np.ones((6000, 3), np.float32))
    assert action.shape == (6000, *space.shape)
    combinations, which, counts = np.unique(action, axis=0, return_inverse=True, return_counts=True)
    p = np.array([np.exp(log_prob[which.ravel() == i][0]) for i in range(len(combinations))])
    assert p.sum() == pytest.approx(1.0, abs=1e-5)  # float32
    assert chisquare(counts, 6000 * p / p.sum()).pvalue > 1e-3


def test_the_probabilities_of_dqns_exploration():
    agent = SB3Agent(CHOICES, algorithm="DQN", seed=2, arguments=OFF_POLICY)
    observation = first_observations(CHOICES, 6000)
    greedy, _ = agent.predict(observation, deterministic=True)
    for rate in (0.0, 0.3):  # an untrained DQN has 0
        agent.model.exploration_rate = rate
        action, _, log_prob = agent.predict_with_log_prob(observation)
        p = np.where(action == greedy, 1 - rate * 2 / 3, rate / 3)
        np.testing.assert_allclose(np.exp(log_prob), p, rtol=1e-12)
        assert (action != greedy).mean() == pytest.approx(rate * 2 / 3, abs=4 * np.sqrt(0.16 / 6000))


@pytest.mark.parametrize(
    "options",
    [
        {"n_stack": 3, "normalize": True, "rescale_actions": True, "arguments": SMALL},
        {"algorithm": "A2C", "n_stack": 2, "arguments": {"policy": "MlpPolicy"}},
        {"algorithm": "RecurrentPPO", "arguments": {**SMALL, "policy": "MlpLstmPolicy"}},
        {"algorithm": "SAC", "normalize": True, "arguments": OFF_POLICY},
        {"algorithm": "SAC", "n_stack": 2, "arguments": OFF_POLICY},
    ],
    ids=["ppo", "a2c", "recurrent", "sac", "sac-stack"],
)
def test_what_is_drawn_with_its_probability_is_what_predict_draws(options):
    """The same torch seed: the same actions as `predict`'s, clipped, and the same memory, over an episode's start."""
    agent = SB3Agent(TASK, seed=1, **options).learn(64)
    env = TASK.make_vec(4)
    observation, _ = env.reset(seed=5)
    ours = theirs = None
    for t in range(6):
        start = np.array([t in (0, 3), t == 0, t == 0, t == 0])
        action, ours, log_prob = with_seed(
            t, agent.predict_with_log_prob, observation, state=ours, episode_start=start
        )
        expected, theirs = with_seed(t, agent.predict, observation, state=theirs, episode_start=start)
        assert log_prob.shape == (4,)
        assert np.isfinite(log_prob).all()
        low, high = agent.action_space.low, agent.action_space.high
        assert np.clip(action, low, high) == pytest.approx(expected, abs=1e-5)  # float32
        for mine, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(mine, other)
        observation, *_ = env.step(expected)


def test_the_density_of_a_recurrent_policy_is_that_of_its_memory():
    agent = SB3Agent(TASK, algorithm="RecurrentPPO", arguments={**SMALL, "policy": "MlpLstmPolicy"})
    observation = first_observations(TASK, 50)
    _, memory, _ = agent.predict_with_log_prob(observation)
    action, _, log_prob = agent.predict_with_log_prob(2.0 * observation, state=memory)
    policy = agent.model.policy
    with torch.no_grad():
        lstm = tuple(torch.tensor(x) for x in memory.recurrent)
        shown = policy.obs_to_tensor(2.0 * observation)[0]
        distribution, _ = policy.get_distribution(shown, lstm, torch.zeros(50))
        theirs = distribution.log_prob(torch.tensor(action)).numpy()
    assert log_prob == pytest.approx(theirs, abs=1e-5)  # float32


def test_one_observation_alone_has_one_log_probability():
    agent = SB3Agent(TASK, algorithm="PPO", n_stack=2, arguments=SMALL)
    observation = first_observations(TASK, 1)
    action, memory, log_prob = with_seed(0, agent.predict_with_log_prob, observation[0])
    batch, _, batched = with_seed(0, agent.predict_with_log_prob, observation)
    assert (action.shape, np.shape(log_prob), batched.shape) == ((1,), (), (1,))
    assert action == batch[0]
    assert log_prob == batched[0]
    agent.predict_with_log_prob(observation[0], state=memory)
    raw = PPO(env=Lopsided(), seed=0, device="cpu", **SMALL)
    action, _, log_prob = with_log_probs(raw).predict_with_log_prob(np.zeros(3, np.float32))
    assert (action.shape, np.shape(log_prob)) == ((2,), ())


@pytest.mark.parametrize("n", [0, 3])
@pytest.mark.parametrize("raw", [False, True])
def test_collect_records_log_probabilities_of_what_is_drawn(n, raw):
    """Recorded with deterministic=False; with True the actions are `predict`'s and there are none."""
    agent = SB3Agent(TASK, algorithm="PPO", seed=0, arguments=SMALL)
    policy = with_log_probs(agent.model) if raw else agent

    def run(deterministic):
        env = TASK.make_vec(n) if n else TASK.make()
        return collect(env, policy, 4, seed=0, deterministic=deterministic, max_steps_per_episode=5)

    drawn = run(False)
    shown = drawn.observations[:, :-1].reshape(-1, 3)
    mean, _ = agent.predict(shown, deterministic=True)
    std = agent.model.policy.log_std.exp().item()
    expected = norm.logpdf(drawn.actions.reshape(-1, 1), mean, std)[:, 0]
    assert drawn.action_log_probs.ravel() == pytest.approx(expected, abs=1e-4)  # float32
    fixed = run(True)
    assert fixed.action_log_probs is None
    mean, _ = agent.predict(fixed.observations[:, :-1].reshape(-1, 3), deterministic=True)
    assert fixed.actions.reshape(-1, 1) == pytest.approx(mean, abs=1e-5)


def test_what_has_no_density_is_told_and_can_be_explored_around():
    td3 = SB3Agent(TASK, algorithm="TD3", arguments=OFF_POLICY)
    observation = first_observations(TASK, 10)
    for has_none in (td3, with_log_probs):
        with pytest.raises(
            ValueError, match=r"draws its actions from a density .*, got TD3; .*GaussianPolicy\(policy, std"
        ):
            has_none(td3.model) if has_none is with_log_probs else td3.predict_with_log_prob(observation)
    ppo = SB3Agent(TASK, algorithm="PPO", arguments=SMALL)
    for policy in (ppo, with_log_probs(ppo.model)):
        with pytest.raises(
            ValueError, match=r"deterministic=False: .* no density; say collect\(.*GaussianPolicy"
        ):
            policy.predict_with_log_prob(observation, deterministic=True)
    with pytest.raises(
        TypeError, match=r"expected a Stable-Baselines3 model, got RandomAgent; .* EpsilonPolicy"
    ):
        with_log_probs(RandomAgent(TASK))
    around = GaussianPolicy(td3, 0.2, seed=0)
    sequences = collect(TASK.make_vec(2), around, 2, seed=0, max_steps_per_episode=5)
    mean, _ = td3.predict(sequences.observations[:, :-1].reshape(-1, 3))
    expected = norm.logpdf(sequences.actions.reshape(-1, 1), mean, 0.2)[:, 0]
    assert sequences.action_log_probs.ravel() == pytest.approx(expected, abs=1e-4)  # float32


def test_epsilon_around_an_agent_of_choices():
    agent = SB3Agent(CHOICES, algorithm="DQN", arguments=OFF_POLICY)
    policy = EpsilonPolicy(agent, 0.3, action_space=agent.action_space, seed=0)
    sequences = collect(CHOICES.make_vec(5), policy, 5, seed=0, max_steps_per_episode=40)
    inside = sequences.step_mask
    greedy, _ = agent.predict(sequences.observations[:, :-1][inside], deterministic=True)
    p = np.where(sequences.actions[inside][:, 0] == greedy, 0.8, 0.1)
    np.testing.assert_allclose(np.exp(sequences.action_log_probs[inside]), p, rtol=1e-12)
    assert {0.1, 0.8} == set(p)


def test_a_trained_dqn_goes_on_exploring_at_its_rate():
    model = DQN(
        env=Lopsided(Discrete(3)),
        seed=0,
        device="cpu",
        exploration_final_eps=0.25,
        train_freq=64,
        **OFF_POLICY,
    ).learn(64)
    _, _, log_prob = with_log_probs(model).predict_with_log_prob(np.zeros((500, 3), np.float32))
    assert set(np.round(np.exp(log_prob), 12)) == {round(0.75 + 0.25 / 3, 12), round(0.25 / 3, 12)}
