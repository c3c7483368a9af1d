"""TorchRL environments from a task: what its wrapper needs of ours, said once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gymnasium.vector import AutoresetMode

from beliefgym.wrappers.task import Task

if TYPE_CHECKING:
    from torchrl.envs import EnvBase


def torchrl_env(task: Task | str, num_envs: int | None = None, device: Any = "cpu") -> EnvBase:
    """A TorchRL environment of a task.

    Args:
        task: the task or environment id.
        num_envs: copies in one batched environment (native where the id has one); None for a single one.
        device: where its tensors are put.

    Returns:
        TorchRL's `GymWrapper`, batch size () or (num_envs,).
    """
    from torchrl.envs import GymWrapper

    task = task if isinstance(task, Task) else Task(task)
    env: Any = task.make() if num_envs is None else task.make_vec(num_envs, AutoresetMode.SAME_STEP)
    return GymWrapper(env, device=device)
