"""The tiers of the leaderboard: which tasks, agents, seeds and budgets.

On-policy and off-policy algorithms use an environment step so differently that one budget for both would be unfair
to one of them: each family has its own, the same for every member, and it stands in the table. The options of every
agent (its hyperparameters too) are written into the cells, so that a change of them is a change of configuration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from beliefgym.agents import find_agent
from beliefgym.envs import registered_ids
from beliefgym.scripts.leaderboard.errors import LeaderboardError
from beliefgym.scripts.leaderboard.grid import AgentVariant, Cell, Grid, product
from beliefgym.wrappers.task import Task

POSITION_ONLY = ("beliefgym/PendulumPosition-v0", "beliefgym/CartPoleSwingUpPosition-v0")
REFERENCES = {"random": 0, "expert": 0}  # agents that do not train
NOISY = tuple(f"beliefgym/PendulumPositionNoisy{level}-v0" for level in ("Easy", "Medium", "Hard"))
BELIEFS = ("sac-psim-hints", "sac-psim-actions")
OF_PPO = tuple(f"ppo-{filter}" for filter in ("psim", "psim-actions", "psim-hints", "known"))
RUNNER = "beliefgym.scripts.run_cell:run_cell"

TIERS: dict[str, dict[str, Any]] = {
    "smoke": {
        "description": "One short run of one agent: does everything work?",
        "tasks": POSITION_ONLY[:1],
        "steps": {"random": 0, "ppo": 8192},
        "seeds": 1,
        "eval_episodes": 20,
        "time_limit_s": 300,
    },
    "standard": {
        "description": "Two position-only tasks and the agents that learn within a quarter of an hour, two seeds.",
        "tasks": POSITION_ONLY,
        "steps": {**REFERENCES, "sac-stack": 10_000, "sac": 10_000, "ppo-stack": 100_000, "ppo": 100_000},
        "seeds": 2,
        "eval_episodes": 100,
        "time_limit_s": 600,
    },
    "full": {
        "description": "Two position-only tasks and every agent, three seeds.",
        "tasks": POSITION_ONLY,
        "steps": {
            **REFERENCES,
            "recurrent-ppo": 100_000,
            "sac-stack": 30_000,
            "sac": 30_000,
            "ppo-stack": 100_000,
            "ppo": 100_000,
        },
        "seeds": 3,
        "eval_episodes": 300,
        "time_limit_s": 3600,
    },
    "belief-pendulum": {
        "description": "The pendulum by its position: SAC on learned beliefs, on four observations and on full sight, "
        "and recurrent PPO, at equal steps (those that filters are fitted to among them).",
        "tasks": POSITION_ONLY[:1],
        "steps": {**REFERENCES, **dict.fromkeys((*BELIEFS, "sac-stack", "recurrent-ppo"), 20_000)},
        "also": (("beliefgym/Pendulum-v0", {**REFERENCES, "sac": 20_000}),),
        "seeds": 10,
        "eval_episodes": 300,
        "time_limit_s": 1800,
    },
    "belief-noisy": {
        "description": "The same under the noise of the suites of hidden-state tasks, with the belief of a particle "
        "filter that knows the system for a ceiling.",
        "tasks": NOISY,
        "steps": {
            **REFERENCES,
            **dict.fromkeys((*BELIEFS, "sac-stack", "recurrent-ppo", "sac-known"), 20_000),
        },
        "seeds": 5,
        "eval_episodes": 300,
        "time_limit_s": 1800,
    },
    "belief-more": {
        "description": "What is left of SAC and PPO on the last observation, four of them, and every belief, on the "
        "exact and on a noisy pendulum.",
        "tasks": (POSITION_ONLY[0], NOISY[1]),
        "steps": {
            **REFERENCES,
            **dict.fromkeys(("sac", "sac-psim", "sac-known"), 20_000),
            **dict.fromkeys(("ppo", "ppo-stack", *OF_PPO), 100_000),
        },
        "seeds": 3,
        "eval_episodes": 300,
        "time_limit_s": 1800,
    },
    "belief-tasks": {
        "description": "Five more partially observed tasks, of which helicopter and quadrotor have noisy sensors: PPO "
        "on learned beliefs and on four observations, and recurrent PPO, at equal steps.",
        "tasks": (
            "beliefgym/CartPoleSwingUpPosition-v0",
            Task("beliefgym/HelicopterHoverNoisy-v0", {}, (("ObservationDelay", {"steps": 1}),)),
            "beliefgym/BaxterReachPosition-v0",
            "beliefgym/QuadrotorHoverIMUPositionNoisy-v0",
            "beliefgym/HopperPosition-v0",
        ),
        "steps": {
            **REFERENCES,
            **dict.fromkeys(("ppo-psim-hints", "ppo-psim-actions", "ppo-stack", "recurrent-ppo"), 100_000),
        },
        "seeds": 5,
        "eval_episodes": 100,
        "time_limit_s": 3600,
    },
    "difficulty": {
        "description": "Every environment and an agent without memory: what hiding a part of the state costs it.",
        "tasks": tuple(registered_ids()),
        "steps": {"ppo": 200_000},
        "seeds": 3,
        "eval_episodes": 100,
        "time_limit_s": 3600,
    },
}


def tier(name: str) -> Grid:
    """The grid of a tier.

    Raises:
        LeaderboardError: an unknown tier.
    """
    if name not in TIERS:
        near = get_close_matches(name, TIERS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise LeaderboardError(f"there is no tier {name!r}{hint} (known: {', '.join(TIERS)})")
    plan = TIERS[name]
    seeds, episodes = range(plan["seeds"]), plan["eval_episodes"]
    tasks = [task if isinstance(task, Task) else Task(task) for task in plan["tasks"]]
    cells = build_cells(tasks, plan["steps"], seeds, episodes)
    for env_id, steps in plan.get("also", ()):  # what only one task has
        cells += build_cells([Task(env_id)], steps, seeds, episodes)
    return Grid(name, cells, time_limit_s=plan["time_limit_s"], description=plan["description"])


def build_cells(
    tasks: Sequence[Task], steps: Mapping[str, int], seeds: Sequence[int], eval_episodes: int
) -> tuple[Cell, ...]:
    """The cells of tasks x agents x seeds, every agent with the options registered for the task.

    Args:
        tasks: the tasks.
        steps: agent -> training steps.
        seeds: seeds of the training.
        eval_episodes: test episodes of each cell.

    Returns:
        the cells, seeds outermost.
    """
    cells: list[Cell] = []
    for seed in seeds:
        for task in tasks:
            variants = [
                AgentVariant(agent, find_agent(agent).options(task.env_id), total_timesteps=budget)
                for agent, budget in steps.items()
            ]
            cells += product([task], variants, [seed], total_timesteps=0, eval_episodes=eval_episodes)
    return tuple(cells)
