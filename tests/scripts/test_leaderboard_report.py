"""Table, files and figures: what they say, and that they say the same again."""

import csv
import io
import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from fake_cells import EXPERT, RANDOM, make_grid, result_of
from rich.console import Console

from beliefgym.scripts.leaderboard.folder import ResultPaths
from beliefgym.scripts.leaderboard.grid import AgentVariant, Cell, Grid
from beliefgym.scripts.leaderboard.plots import (
    STILL,
    _common_steps,
    _look,
    curves_figure,
    scores_figure,
    write_plots,
)
from beliefgym.scripts.leaderboard.pool import Outcome
from beliefgym.scripts.leaderboard.records import Record
from beliefgym.scripts.leaderboard.report import interval, markdown, number, print_table, write_report
from beliefgym.scripts.leaderboard.run import as_record
from beliefgym.scripts.leaderboard.statistics import Estimate, estimate
from beliefgym.scripts.leaderboard.table import leaderboard

AGENTS = ("weak", "strong", AgentVariant("random", total_timesteps=0))
GRID = make_grid(AGENTS, seeds=3)
PATHS = ResultPaths(Path("results"), "standard")


def record_of(cell: Cell, *, reason: str | None = None, when: str = "2026-01-31", **fields: object) -> Record:
    result = None if reason else result_of(cell.to_dict()) | fields
    return as_record(cell, Outcome(result, reason, None, when, when, 1.0))


def records_of(
    grid: Grid, failed: Mapping[str, str] | None = None, *, when: str = "2026-01-31"
) -> dict[str, Record]:
    """A record for each cell; those in `failed` with the reason given there."""
    return {cell.key: record_of(cell, reason=(failed or {}).get(cell.key), when=when) for cell in grid.cells}


def test_the_better_agent_comes_first_and_its_numbers_are_those_of_its_records() -> None:
    records = records_of(GRID)
    board = leaderboard(GRID, records)
    assert [(row.rank, row.agent) for row in board.overall] == [(1, "strong"), (2, "weak"), (3, "random")]
    returns = {
        task: [
            np.mean(records[cell.key].result["returns"])
            for cell in GRID.cells
            if (cell.task_label, cell.agent) == (task, "strong")
        ]
        for task in GRID.tasks
    }
    scores = [(np.array(values) - RANDOM) / (EXPERT - RANDOM) for values in returns.values()]
    best = board.overall[0]
    assert best.score.value == pytest.approx(estimate(scores).value)
    assert best.score.low == pytest.approx(estimate(scores).low)
    on_task = board.tasks[0].rows[0]
    values = np.array(returns[GRID.tasks[0]])
    assert on_task.mean_return == pytest.approx(values.mean())
    assert on_task.standard_error == pytest.approx(values.std(ddof=1) / math.sqrt(3))
    assert on_task.training_steps == 1000
    assert board.tasks[0].references == ((RANDOM, EXPERT),)


def test_failed_and_missing_cells_are_rows_with_their_reason() -> None:
    records = records_of(GRID, {"Pendulum-v0/strong/seed-1": "exceeded its time limit of 600 s"})
    del records["CartPole-v0/weak/seed-2"]
    board = leaderboard(GRID, records)
    assert [(row.cell.key, row.reason) for row in board.unfinished] == [
        ("Pendulum-v0/strong/seed-1", "exceeded its time limit of 600 s"),
        ("CartPole-v0/weak/seed-2", "has not run yet"),
    ]
    assert {row.agent: (row.n_finished, row.n_cells, row.score.n_runs) for row in board.overall} == {
        "strong": (5, 6, 5),
        "weak": (5, 6, 5),
        "random": (6, 6, 6),
    }
    text = markdown(board, PATHS, "beliefgym leaderboard")
    assert "| Pendulum-v0 | strong | 1 | exceeded its time limit of 600 s |" in text
    assert "| CartPole-v0 | weak | 2 | has not run yet |" in text
    assert "With cells that have no result: strong, weak; reasons are at the end." in text
    assert re.search(r"\| 1 \| strong \|.*\| 5/6 \|", text)


def test_an_agent_that_lacks_a_task_ranks_after_those_that_have_all() -> None:
    failed = {f"CartPole-v0/strong/seed-{seed}": "it broke" for seed in range(3)}
    board = leaderboard(GRID, records_of(GRID, failed))
    assert [row.agent for row in board.overall] == ["weak", "random", "strong"]
    assert board.overall[-1].score.value > board.overall[0].score.value
    assert "ranked after those that are: strong" in markdown(board, PATHS, "x")
    assert board.tasks[1].rows[-1].rank is None


def test_a_table_without_any_result_still_comes() -> None:
    board = leaderboard(GRID, {})
    text = markdown(board, PATHS, "x")
    assert "18 of 18 cells" in text
    assert "| — | weak | — | — | — | — | 0/6 |" in text
    assert "References: not known, as no cell has finished." in text
    scores_figure(board)
    curves_figure(board, board.tasks[0])


def test_one_seed_shows_a_dash_for_the_interval_and_says_why() -> None:
    grid = make_grid(AGENTS, seeds=1)
    text = markdown(leaderboard(grid, records_of(grid)), PATHS, "x")
    assert "— in place of an interval: it needs at least two finished runs on each task." in text
    assert "[" not in text.split("## All tasks")[1].split("![")[0]


def test_changed_references_are_told() -> None:
    records = records_of(GRID)
    cell = GRID.cells[0]
    records[cell.key] = record_of(cell, expert_score=-100.0)
    assert "The references changed between these cells" in markdown(leaderboard(GRID, records), PATHS, "x")


def test_the_ranking_does_not_depend_on_when_or_in_which_order_cells_ran() -> None:
    first, second = records_of(GRID, when="2026-01-31"), records_of(GRID, when="2027-12-01")
    backwards = dict(reversed(second.items()))
    assert markdown(leaderboard(GRID, first), PATHS, "x") == markdown(
        leaderboard(GRID, backwards), PATHS, "x"
    )


def test_probability_of_improvement_is_antisymmetric_and_in_the_table() -> None:
    board = leaderboard(GRID, records_of(GRID))
    assert board.improvement["strong", "weak"].value == 1.0
    assert board.improvement["weak", "strong"].value == 0.0
    assert "| strong | — | **1.00** | **1.00** |" in markdown(board, PATHS, "x")


def test_the_page_says_how_to_make_it_again_and_its_links_lead_somewhere(tmp_path: Path) -> None:
    paths = ResultPaths(tmp_path, "standard")
    board = leaderboard(GRID, records_of(GRID))
    paths.records.mkdir(parents=True)
    write_report(board, paths, "beliefgym leaderboard --tier standard")
    write_plots(board, paths)
    text = paths.table.read_text()
    assert "```\nbeliefgym leaderboard --tier standard\n```" in text
    assert "Versions: torch 2.13.0." in text
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert len(links) == 7  # scores, profiles, curves of two tasks, records, cells, times
    assert all((paths.table.parent / link).exists() for link in links)


def test_the_csv_has_a_row_for_every_cell(tmp_path: Path) -> None:
    paths = ResultPaths(tmp_path, "full")
    records = records_of(GRID, {"Pendulum-v0/strong/seed-1": 'it "broke", badly'})
    write_report(leaderboard(GRID, records), paths, "x")
    rows = list(csv.DictReader(io.StringIO(paths.csv.read_text())))
    assert [(row["task"], row["agent"], int(row["seed"])) for row in rows] == [
        (cell.task_label, cell.agent, cell.seed) for cell in GRID.cells
    ]
    broken = next(row for row in rows if row["status"] == "failed")
    assert (broken["agent"], broken["reason"], broken["score"]) == ("strong", 'it "broke", badly', "")
    whole = rows[0]
    result = records[GRID.cells[0].key].result
    assert result is not None
    assert float(whole["mean_return"]) == np.mean(result["returns"])
    assert float(whole["std_return"]) == np.std(result["returns"])
    assert whole["record"] == "records/full/Pendulum-v0/weak/seed-0.json"
    times = list(csv.DictReader(io.StringIO(paths.timing.read_text())))
    assert len(times) == len(GRID.cells)
    assert (times[0]["wall_time_s"], times[0]["training_steps_per_s"]) == ("1.0", "2000.0")


def test_the_terminal_shows_the_table_within_80_columns_and_the_paths() -> None:
    board = leaderboard(GRID, records_of(GRID, {"Pendulum-v0/strong/seed-1": "[red]x[/red] | y"}))
    console = Console(file=io.StringIO(), width=80)
    print_table(board, PATHS, console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "…" not in text
    assert all(len(line) <= 80 for line in text.splitlines() if "results" not in line)
    assert "no result Pendulum-v0/strong/seed-1: [red]x[/red] | y" in text
    for path in (PATHS.table, PATHS.csv, PATHS.plots, PATHS.records):
        assert str(path) in text


def test_pipes_in_reasons_do_not_break_the_table() -> None:
    text = markdown(leaderboard(GRID, records_of(GRID, {GRID.cells[0].key: "a | b"})), PATHS, "x")
    assert "| Pendulum-v0 | weak | 0 | a \\| b |" in text


def test_numbers_are_written_plainly() -> None:
    assert number(-0.0001) == "0.000"
    assert number(float("nan")) == "—"
    assert number(-145.26, 1) == "-145.3"
    assert interval(Estimate(0.5, 0.25, 0.75, 3)) == "[0.250, 0.750]"
    assert interval(Estimate(0.5, math.nan, math.nan, 1)) == "—"


def test_figures_are_the_same_bytes_again(tmp_path: Path) -> None:
    board = leaderboard(GRID, records_of(GRID))
    for folder in ("one", "two"):
        write_plots(board, ResultPaths(tmp_path / folder, "standard"))
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.*g"))
    assert len(files) == 8  # scores, profiles and the curves of two tasks, as PNG and SVG
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_curves_show_the_mean_over_seeds_and_the_references() -> None:
    board = leaderboard(GRID, records_of(GRID))
    axes = curves_figure(board, board.tasks[0]).axes[0]
    line = next(line for line in axes.lines if line.get_label() == "strong")
    results = [
        row.result
        for row in board.cells
        if (row.cell.agent, row.cell.task_label) == ("strong", board.tasks[0].task) and row.result
    ]
    last = np.mean([result["learning_curve"][-1]["mean_return"] for result in results])
    assert line.get_xdata()[-1] == 1000
    assert line.get_ydata()[-1] == pytest.approx(last)
    levels = [line.get_ydata()[0] for line in axes.lines if line.get_label() != "strong"]
    assert {RANDOM, EXPERT} <= set(levels)
    assert {text.get_text() for text in axes.texts} >= {"expert −140", "random −1200"}


def test_bars_are_as_long_as_the_scores() -> None:
    board = leaderboard(GRID, records_of(GRID))
    bars = scores_figure(board).axes[0].patches
    assert [bar.get_width() for bar in bars] == pytest.approx([row.score.value for row in board.overall])


def test_an_agent_keeps_its_colour_and_those_that_do_not_learn_are_grey() -> None:
    full = leaderboard(GRID, records_of(GRID))
    failing = leaderboard(
        GRID, records_of(GRID, {cell.key: "x" for cell in GRID.cells if cell.agent == "strong"})
    )
    assert _look(full, "weak") == _look(failing, "weak")
    assert _look(full, "random")[0] == STILL
    many = make_grid(tuple(f"agent-{i}" for i in range(20)), seeds=1)
    assert len({str(_look(leaderboard(many, {}), agent)) for agent in many.agents}) == 20


def test_curves_at_different_steps_meet_where_both_have_values() -> None:
    one = (np.array([0.0, 10.0, 20.0]), np.array([0.0, 10.0, 20.0]))
    two = (np.array([5.0, 25.0]), np.array([50.0, 250.0]))
    steps, values = _common_steps([one, two])
    assert steps.tolist() == [5.0, 10.0, 20.0]
    assert values.tolist() == [[5.0, 10.0, 20.0], [50.0, 100.0, 200.0]]
