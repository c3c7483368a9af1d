"""Records and the results folder: whole or not at all, checked when read, told when they do not fit."""

import dataclasses
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_cells import make_grid, result_of

from beliefgym.scripts.leaderboard.errors import CorruptRecordError, ResultsFolderError
from beliefgym.scripts.leaderboard.folder import (
    ResultPaths,
    check_writable,
    clear_leftovers,
    hold_lock,
    move_aside,
    write_atomically,
)
from beliefgym.scripts.leaderboard.pool import Outcome
from beliefgym.scripts.leaderboard.records import (
    Record,
    ResultError,
    check_result,
    differences,
    read_record,
    set_aside_corrupt,
    set_aside_old,
    take_stock,
    write_record,
)
from beliefgym.scripts.leaderboard.run import as_record

GRID = make_grid()
CELL = GRID.cells[0]
RESULT = result_of(CELL.to_dict())


def finished(cell: Any = CELL) -> Record:
    when = "2026-01-31T12:00:00+00:00"
    return as_record(cell, Outcome(result_of(cell.to_dict()), None, None, when, when, 1.5))


@pytest.fixture
def paths(tmp_path: Path) -> ResultPaths:
    return ResultPaths(tmp_path / "results", "standard")


def test_a_record_comes_back_as_it_was(paths: ResultPaths) -> None:
    record = finished()
    write_record(paths.record(CELL), record)
    assert read_record(paths.record(CELL)) == record
    assert json.loads(paths.record(CELL).read_text())["status"] == "finished"


def test_the_tier_full_has_the_plain_names_and_others_do_not_overwrite_it(tmp_path: Path) -> None:
    full, standard = ResultPaths(tmp_path, "full"), ResultPaths(tmp_path, "standard")
    assert [path.name for path in (full.table, full.csv, full.timing)] == [
        *("leaderboard.md", "leaderboard.csv", "leaderboard_timing.csv")
    ]
    assert [path.name for path in (standard.table, standard.csv, standard.timing)] == [
        *("leaderboard_standard.md", "leaderboard_standard.csv", "leaderboard_standard_timing.csv")
    ]
    assert standard.record(CELL) == tmp_path / "records/standard/Pendulum-v0/weak/seed-0.json"
    assert full.plots != standard.plots


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "record.json"
    write_atomically(path, "old")

    def full_disk(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["record.json"]


def test_leftovers_of_a_killed_writer_are_cleared(paths: ResultPaths) -> None:
    write_record(paths.record(CELL), finished())
    leftover = paths.record(CELL).parent / ".seed-0.json.abc.tmp"
    leftover.write_text("{")
    clear_leftovers(paths)
    assert not leftover.exists()
    assert paths.record(CELL).exists()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: text[: len(text) // 2], "is not readable JSON"),
        (lambda text: "", "is not readable JSON"),
        (lambda text: "[1, 2]", "holds a list, not a record"),
        (
            lambda text: text.replace('"format": 1', '"format": 7'),
            "has record format 7, this version reads 1",
        ),
        (lambda text: text.replace('"reason"', '"raison"'), "lacks or has too much: raison, reason"),
        (
            lambda text: text.replace('"finished",', '"done",', 1),
            "its status is 'done', not finished or failed",
        ),
        (lambda text: text.replace('"seed": 0', '"seed": 1'), "its config_hash .* is not that of its cell"),
        (lambda text: text.replace('"std": 9.0', '"std": NaN', 1), "NaN is not JSON"),
        (lambda text: text.replace('"learning_curve"', '"curve"'), "the result lacks learning_curve"),
    ],
)
def test_a_corrupt_record_is_told_with_its_file(
    paths: ResultPaths, spoil: Callable[[str], str], message: str
) -> None:
    path = paths.record(CELL)
    write_record(path, finished())
    spoiled = spoil(path.read_text())
    assert spoiled != path.read_text()
    path.write_text(spoiled)
    with pytest.raises(CorruptRecordError, match=f"seed-0.json .*{message}"):
        read_record(path)


def test_binary_rubbish_is_a_corrupt_record(paths: ResultPaths) -> None:
    write_atomically(paths.record(CELL), b"\xff\xfe\x00\x80")
    with pytest.raises(CorruptRecordError, match="is not readable JSON"):
        read_record(paths.record(CELL))


def test_files_set_aside_never_overwrite_each_other(tmp_path: Path) -> None:
    names = []
    for content in "abc":
        path = tmp_path / "seed-0.json"
        path.write_text(content)
        names.append(set_aside_corrupt(path).name)
    assert names == ["seed-0.json.corrupt", "seed-0-2.json.corrupt", "seed-0-3.json.corrupt"]
    assert sorted(path.read_text() for path in tmp_path.iterdir()) == ["a", "b", "c"]


def test_an_old_record_is_set_aside_with_its_date(tmp_path: Path) -> None:
    path = tmp_path / "seed-0.json"
    path.write_text("{}")
    aside = set_aside_old(path)
    assert aside.name.startswith("seed-0.old-20")
    assert aside.suffix == ".json"
    assert move_aside(aside, "seed-0.json") == path


def change(result: dict[str, Any], **fields: Any) -> dict[str, Any]:
    return {**result, **fields}


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (None, "the result of a cell is a dict, not a NoneType"),
        ({"returns": [1.0]}, "the result lacks random_score, expert_score, learning_curve, training"),
        (change(RESULT, returns=[1.0, 2.0]), "one number for each of 5 episodes, not 2"),
        (change(RESULT, returns="abc"), "one number for each of 5 episodes, not a str"),
        (change(RESULT, returns=[1.0, 2.0, 3.0, float("-inf"), 5.0]), r"result\.returns\[3\] is -inf"),
        (
            change(RESULT, returns=[1.0, 2.0, 3.0, None, 5.0]),
            r"result\.returns\[3\] is a finite number, not None",
        ),
        (
            change(RESULT, returns=[1.0, 2.0, 3.0, True, 5.0]),
            r"result\.returns\[3\] is a finite number, not True",
        ),
        (
            change(RESULT, expert_score=-1200),
            "expert_score is above result.random_score, not -1200 against -1200",
        ),
        (
            change(RESULT, training={"steps": 1}),
            r"result\.training\.wall_time_s is a finite number, not None",
        ),
        (change(RESULT, training=[]), "result.training is a dict with steps"),
        (change(RESULT, versions=[]), "result.versions is a dict"),
        (change(RESULT, learning_curve={}), "result.learning_curve is a list"),
        (change(RESULT, learning_curve=[1]), r"result\.learning_curve\[0\] is a dict"),
        (
            change(RESULT, learning_curve=[{"step": 1, "std": 1}]),
            r"learning_curve\[0\]\.mean_return is a finite",
        ),
        (change(RESULT, spec={"x": [float("nan")]}), r"result\.spec\.x\[0\] is nan, not a finite number"),
    ],
)
def test_an_incomplete_result_is_told_by_the_field(result: Any, message: str) -> None:
    with pytest.raises(ResultError, match=message):
        check_result(result, CELL)
    record = as_record(CELL, Outcome(result, None, None, "", "", 1.0))
    assert (record.status, record.result) == ("failed", None)


def test_differences_name_the_field_and_both_values() -> None:
    old = {"steps": 30000, "options": {"lr": 0.001, "net": [64]}, "same": 1}
    new = {"steps": 50000, "options": {"net": [64, 64]}, "same": 1, "extra": "x"}
    assert differences(old, new) == [
        "steps: 30000 -> 50000",
        "options.lr: 0.001 -> (not there)",
        "options.net: [64] -> [64, 64]",
        'extra: (not there) -> "x"',
    ]


def test_the_stock_sorts_what_lies_there(paths: ResultPaths) -> None:
    usable, changed, corrupt, missing = GRID.cells[:4]
    write_record(paths.record(usable), finished(usable))
    write_record(paths.record(changed), finished(dataclasses.replace(changed, total_timesteps=7)))
    write_atomically(paths.record(corrupt), "{")
    write_atomically(paths.records / "Gone-v0/weak/seed-0.json", "{}")
    write_atomically(paths.records / "Pendulum-v0/weak/seed-0.old-2026.json", "{}")
    stock = take_stock(GRID, paths)
    assert set(stock.records) == {usable.key}
    assert [(one.cell, one.differences) for one in stock.changed] == [
        (changed, ("total_timesteps: 7 -> 1000",))
    ]
    assert list(stock.corrupt) == [paths.record(corrupt)]
    assert stock.strangers == (paths.records / "Gone-v0/weak/seed-0.json",)
    assert not paths.record(missing).exists()


@pytest.fixture
def read_only_folder() -> Iterator[Path]:
    """A folder that this process cannot write, even where the tests run as root."""
    with tempfile.TemporaryDirectory(prefix="beliefgym-") as folder:
        results = Path(folder, "results")
        results.mkdir()
        os.chmod(folder, 0o755)
        os.chmod(results, 0o555)
        was_root = os.geteuid() == 0
        if was_root:
            os.seteuid(65534)
        try:
            yield results
        finally:
            if was_root:
                os.seteuid(0)
            os.chmod(results, 0o755)


def test_a_read_only_results_folder_is_told_before_any_training(read_only_folder: Path) -> None:
    message = rf"cannot be written: {read_only_folder}: Permission denied.*chmod.*--results-dir"
    with pytest.raises(ResultsFolderError, match=message):
        check_writable(ResultPaths(read_only_folder, "standard"), GRID)


def test_a_file_in_place_of_a_folder_is_told(paths: ResultPaths) -> None:
    write_atomically(paths.records, "I am a file")
    with pytest.raises(ResultsFolderError, match=r"cannot be written: .*standard"):
        check_writable(paths, GRID)


def test_the_probe_leaves_nothing_behind(paths: ResultPaths) -> None:
    check_writable(paths, GRID)
    assert [path for path in paths.results_dir.rglob("*") if path.is_file()] == []


def test_a_second_run_in_the_same_folder_is_refused_until_the_first_has_ended(paths: ResultPaths) -> None:
    check_writable(paths, GRID)
    with hold_lock(paths):
        message = rf"another leaderboard is running .*process {os.getpid()}\).*--results-dir"
        with pytest.raises(ResultsFolderError, match=message), hold_lock(paths):
            pass
    with hold_lock(paths):
        pass
