"""The command line: one verb a job.

Threads are set here on purpose, before numpy and torch are loaded: the networks and batches of this suite are small,
and one thread a process is faster than many; `BELIEFGYM_THREADS` says otherwise.
"""

from __future__ import annotations

import os
import sys
import traceback
from typing import Any

THREADS = os.environ.get("BELIEFGYM_THREADS", "1")
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, THREADS)
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

DESCRIPTION = """Partially observed control environments, belief states and the agents that act on them.

`beliefgym COMMAND --help` explains a command, with examples."""


def commands() -> dict[str, Any]:
    """The verbs and their classes; each is a dataclass of options with a `run() -> exit code`."""
    from beliefgym.scripts.benchmark import Benchmark
    from beliefgym.scripts.evaluate import Evaluate, Record
    from beliefgym.scripts.leaderboard.command import Leaderboard
    from beliefgym.scripts.listing import Agents, Envs
    from beliefgym.scripts.reproduce import Reproduce
    from beliefgym.scripts.train import Train

    return {
        "train": Train,
        "evaluate": Evaluate,
        "record": Record,
        "leaderboard": Leaderboard,
        "reproduce": Reproduce,
        "benchmark": Benchmark,
        "envs": Envs,
        "agents": Agents,
    }


def main(arguments: list[str] | None = None) -> None:
    """Parse, run and exit: 0 done, 1 done with failures, 2 bad input, 130 after Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        sys.exit(_run(arguments))
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        sys.exit(130)


def _run(arguments: list[str]) -> int:
    import torch
    import tyro

    from beliefgym.scripts.leaderboard.errors import LeaderboardError

    torch.set_num_threads(int(THREADS))
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # so that module:attribute finds a file of the user's beside him
    command: Any = tyro.extras.subcommand_cli_from_dict(
        commands(),
        prog="beliefgym",
        description=DESCRIPTION,
        args=arguments,
    )
    try:
        return int(command.run())
    except (ValueError, TypeError, OSError, ImportError, LeaderboardError) as error:
        if os.environ.get("BELIEFGYM_TRACEBACK"):
            traceback.print_exc()
        print(f"beliefgym: {error}", file=sys.stderr)
        print("(set BELIEFGYM_TRACEBACK=1 to see where it came from)", file=sys.stderr)
        return 2


if __name__ == "__main__":
    main()
