"""Which agents there are, by name; an agent of the user's own joins by entry point or as "module:attribute"."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from beliefgym.agents.agent import HEADER, Agent, read_archive
from beliefgym.agents.hyperparameters import action_bins, hyperparameters, recurrent_q, recurrent_sac
from beliefgym.wrappers.task import Task

GROUP = "beliefgym.agents"


@dataclass(frozen=True)
class AgentSpec:
    """A registered agent.

    Args:
        name: what it is called on the command line and in tables.
        entry_point: "module:attribute" of a class (or function) called as `(task, seed=..., **options)`.
        description: one line.
        options: environment id -> the options it gets there by default.
        learns: False for references that do not train.
    """

    name: str
    entry_point: str
    description: str
    options: Callable[[str], dict[str, Any]] = lambda env_id: {}
    learns: bool = True


_REGISTRY: dict[str, AgentSpec] = {}


def register_agent(spec: AgentSpec) -> None:
    """Add an agent.

    Raises:
        ValueError: the name is taken by another agent.
    """
    if spec.name in _REGISTRY and _REGISTRY[spec.name].entry_point != spec.entry_point:
        raise ValueError(f"there is an agent {spec.name!r} already: {_REGISTRY[spec.name].entry_point}")
    _REGISTRY[spec.name] = spec


def agent_specs() -> dict[str, AgentSpec]:
    """Every agent by name: the package's, then those of installed packages (entry points of group beliefgym.agents)."""
    specs = dict(_REGISTRY)
    for point in entry_points(group=GROUP):
        if point.name not in specs:
            origin = point.dist.name if point.dist else "an installed package"
            specs[point.name] = AgentSpec(point.name, point.value, f"from {origin}")
    return specs


def find_agent(name: str) -> AgentSpec:
    """The agent of a name, or of "module:attribute".

    Raises:
        ValueError: no such agent; the message names the nearest.
    """
    specs = agent_specs()
    if name in specs:
        return specs[name]
    if ":" in name:
        return AgentSpec(name, name, "given as module:attribute")
    near = get_close_matches(name, specs, n=1, cutoff=0.4)
    raise ValueError(
        f"there is no agent {name!r}"
        + (f"; did you mean {near[0]!r}?" if near else "")
        + f" (known: {', '.join(specs)}; or module:attribute of your own)"
    )


def make_agent(name: str, task: Task | str, seed: int = 0, **options: Any) -> Agent:
    """Build an agent by name.

    Args:
        name: a registered name or "module:attribute".
        task: the task or environment id.
        seed: its seed.
        **options: in place of the registered options of the same name; an unknown one is an error.

    Raises:
        ValueError: no such agent, or "module:attribute" that does not lead anywhere.
        TypeError: an option that the agent does not take.
    """
    spec = find_agent(name)
    task = task if isinstance(task, Task) else Task(task)
    chosen = {**spec.options(task.env_id), **options}
    try:
        agent: Agent = _load(spec.entry_point)(task, seed=seed, **chosen)
    except TypeError as error:
        if "unexpected keyword argument" in str(error):
            raise TypeError(
                f"agent {name!r}: {error}; it takes {', '.join(sorted(chosen)) or 'no options'}"
            ) from error
        raise
    agent.registered_name = spec.name
    return agent


def load_agent(path: str | os.PathLike[str], task: Task | str | None = None) -> Agent:
    """Load any saved agent; see `Agent.load`. The file names the class, which must be importable here."""
    header, _ = read_archive(Path(path))
    try:
        loaded: Agent = _load(header["class"]).load(path, task)
    except KeyError as error:
        raise ValueError(f"{path}: {HEADER} lacks {error}: {json.dumps(header)[:200]}") from error
    return loaded


def _load(entry_point: str) -> Any:
    module, _, attribute = entry_point.partition(":")
    try:
        target: Any = import_module(module)
        for part in attribute.split("."):
            target = getattr(target, part)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"cannot load the agent {entry_point!r}: {error}") from error
    return target


def _sb3(algorithm: str, **more: Any) -> Callable[[str], dict[str, Any]]:
    return lambda env_id: {**hyperparameters(algorithm, env_id), **more}


def _sac_stack(env_id: str) -> dict[str, Any]:
    """SAC with 4 frames; on the pendulum with a constant learning rate, which stacks are better with there."""
    options = {**hyperparameters("SAC", env_id), "n_stack": 4}
    if env_id.rpartition("/")[2].startswith("Pendulum"):
        options["arguments"] = {**options["arguments"], "learning_rate": 1e-3}
    return options


def _belief(algorithm: str, filter: str) -> Callable[[str], dict[str, Any]]:
    """The algorithm's usual options on beliefs, whatever they are without."""

    def options(env_id: str) -> dict[str, Any]:
        chosen = {**hyperparameters(algorithm, env_id), "filter": filter}
        if filter not in _LEARNED:
            return {**chosen, "filter": _known_filter(env_id)}
        # as `belief_filters` has it, written out so that a record says it
        is_noisy = filter == "psim-hints" and "Noisy" in env_id
        return {**chosen, "filter_options": {"alpha": 1e-4 if is_noisy else 1e-6}}

    return options


def _known_filter(env_id: str) -> str:
    """Of the pendulums, whose angle is anywhere at first, a cloud of particles; elsewhere one Gaussian does."""
    return "particle" if env_id.rpartition("/")[2].startswith("Pendulum") else "ekf"


def _delays(env_id: str) -> dict[str, Any]:
    """Two observations make the state where positions alone are shown."""
    return {"delays": 2} if env_id.rpartition("-v")[0].endswith("Position") else {}


def _recurrent_q(env_id: str) -> dict[str, Any]:
    return {**recurrent_q(env_id), "auxiliary": {"predictive_state": {"weight": 1.0, "k": 5}}}


_SB3 = "beliefgym.agents.sb3_agent:SB3Agent"
_BELIEF = "beliefgym.agents.belief_policy:BeliefPolicy"
_RECURRENT = "beliefgym.agents.recurrent"
_LEARNED = {
    "psim": "a predictive state of observations alone",
    "psim-actions": "a predictive state with actions",
    "psim-hints": "a predictive state trained with the environment's hints",
}

for _spec in (
    AgentSpec(
        "random", "beliefgym.agents.random_agent:RandomAgent", "uniform actions; score 0", learns=False
    ),
    AgentSpec("expert", "beliefgym.agents.expert:Expert", "true model and full state; score 1", learns=False),
    AgentSpec(
        "filter-expert",
        "beliefgym.agents.filter_expert:FilterExpert",
        "the expert on the estimate of a Kalman filter that knows the system",
        learns=False,
    ),
    AgentSpec("ppo", _SB3, "SB3's PPO on the last observation alone", _sb3("PPO")),
    AgentSpec("ppo-stack", _SB3, "SB3's PPO on the last 4 observations", _sb3("PPO", n_stack=4)),
    AgentSpec("sac", _SB3, "SB3's SAC on the last observation alone", _sb3("SAC")),
    AgentSpec("sac-stack", _SB3, "SB3's SAC on the last 4 observations", _sac_stack),
    AgentSpec("dqn-stack", _SB3, "SB3's DQN on the last 4 observations", _sb3("DQN", n_stack=4)),
    AgentSpec(
        "dad-control",
        "beliefgym.agents.dad_control:DaDControl",
        "model-based: DAgger system identification with Data as Demonstrator, iLQR",
        lambda env_id: _delays(env_id),
    ),
    AgentSpec(
        "dagger-control",
        "beliefgym.agents.dad_control:DaDControl",
        "the same with the single-step model",
        lambda env_id: {"dad": False, **_delays(env_id)},
    ),
    AgentSpec(
        "pets",
        "beliefgym.agents.probabilistic_ensemble:ProbabilisticEnsembleControl",
        "model-based rival: ensemble of probabilistic networks, trajectory sampling, cross-entropy planning",
    ),
    AgentSpec(
        "recurrent-q",
        f"{_RECURRENT}:RecurrentQSARSA",
        "Recurrent-Q SARSA (LSTM) with a predictive-state objective",
        _recurrent_q,
    ),
    AgentSpec("drqn", f"{_RECURRENT}:DRQN", "recurrent Q-learning from a replay of episodes", action_bins),
    AgentSpec(
        "r2d2", f"{_RECURRENT}:R2D2", "recurrent Q-learning from stored states, with burn-in", action_bins
    ),
    AgentSpec(
        "recurrent-pqn",
        f"{_RECURRENT}:RecurrentPQN",
        "recurrent Q-learning with lambda-returns, neither replay nor target network",
        action_bins,
    ),
    AgentSpec(
        "recurrent-sac",
        f"{_RECURRENT}:RecurrentSAC",
        "soft actor-critic with recurrent actor and critic",
        recurrent_sac,
    ),
    AgentSpec("recurrent-ppo", _SB3, "sb3-contrib's RecurrentPPO (LSTM)", _sb3("RecurrentPPO")),
    *(
        AgentSpec(
            f"{algorithm.lower()}-{filter}",
            _BELIEF,
            f"SB3's {algorithm} on the last observation and {what}",
            _belief(algorithm, filter),
        )
        for algorithm in ("PPO", "SAC")
        for filter, what in {**_LEARNED, "known": "the belief of a filter that knows the system"}.items()
    ),
):
    register_agent(_spec)
