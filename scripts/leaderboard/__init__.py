"""The leaderboard: agents, tasks and seeds as a grid, one record a finished cell, and a ranking."""

from beliefgym.scripts.leaderboard.errors import LeaderboardError
from beliefgym.scripts.leaderboard.folder import ResultPaths
from beliefgym.scripts.leaderboard.grid import AgentVariant, Cell, Grid, product
from beliefgym.scripts.leaderboard.records import Record, read_record
from beliefgym.scripts.leaderboard.run import LeaderboardOptions, run_grid, run_leaderboard

__all__ = [
    "AgentVariant",
    "Cell",
    "Grid",
    "LeaderboardError",
    "LeaderboardOptions",
    "Record",
    "ResultPaths",
    "product",
    "read_record",
    "run_grid",
    "run_leaderboard",
]
