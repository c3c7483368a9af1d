"""beliefgym: partially observed control environments, learned belief states and the agents that act on them.

Importing the package registers its environments: `gymnasium.make("beliefgym/PendulumPosition-v0")`.
"""

from importlib import import_module

from beliefgym._version import __version__

try:
    import_module("beliefgym.envs").register_all()
except ModuleNotFoundError as error:
    if error.name != "beliefgym.envs":
        raise
    raise ModuleNotFoundError(
        "beliefgym/envs is not there: this checkout has lost its symbolic links (src/beliefgym/envs -> "
        "../../envs and so on). Check out again with `git config core.symlinks true`, or install a wheel.",
        name=error.name,
    ) from error

__all__ = ["__version__"]
