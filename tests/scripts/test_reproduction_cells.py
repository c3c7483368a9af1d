"""Cells of a reproduction: written down one by one, not run twice, told where they changed or failed."""

import json
import os

import pytest

from beliefgym.scripts.reproductions.cells import run_cells

CELLS = {f"x-{x}": {"x": x} for x in (2, 3, 5)}
SQUARED, DYING = "broken_cells:squared", "broken_cells:dying"


@pytest.mark.parametrize("jobs", [1, 2])
def test_each_cell_has_its_file_and_is_not_run_again(tmp_path, jobs):
    told = []
    first = run_cells(SQUARED, CELLS, tmp_path, jobs, told.append)
    assert [result["square"] for result in first.values()] == [4, 9, 25]
    assert len(told) == 3
    record = json.loads((tmp_path / "x-3.json").read_text())
    assert record["cell"] == {"x": 3}
    assert record["result"]["square"] == 9
    assert "numpy" in record["versions"]
    written = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    (tmp_path / "x-5.json").unlink()
    again = run_cells(SQUARED, CELLS, tmp_path, jobs, told.append)
    assert again["x-2"] == first["x-2"]  # the same process number: it was read
    assert told[3:] == ["x-5 (3 of 3)"]
    assert (tmp_path / "x-2.json").stat().st_mtime_ns == written["x-2.json"]


@pytest.mark.parametrize(("fresh", "fewest", "most"), [(True, 3, 3), (False, 1, 2)])
def test_processes_are_new_or_go_on(tmp_path, fresh, fewest, most):
    found = run_cells(SQUARED, CELLS, tmp_path, 2, lambda text: None, fresh=fresh)
    assert [result["square"] for result in found.values()] == [4, 9, 25]
    assert fewest <= len({result["process"] for result in found.values()}) <= most


def test_a_changed_cell_is_told_and_runs_again(tmp_path):
    run_cells(SQUARED, CELLS, tmp_path, 1, lambda text: None)
    told = []
    found = run_cells(SQUARED, CELLS | {"x-2": {"x": 4}}, tmp_path, 1, told.append)
    assert found["x-2"]["square"] == 16
    assert told[0] == "x-2: its configuration has changed since it was run; it runs again"


def test_a_cell_that_fails_has_its_reason_and_is_tried_again(tmp_path):
    jobs = 1
    switch = tmp_path / "switch"
    switch.touch()
    found = run_cells(SQUARED, CELLS, tmp_path / "cells", jobs, lambda text: None, str(switch))
    assert found["x-3"]["failed"] == "ValueError: no threes"
    assert found["x-5"]["square"] == 25
    assert not (tmp_path / "cells" / "x-3.json").exists()
    switch.unlink()
    assert (
        run_cells(SQUARED, CELLS, tmp_path / "cells", jobs, lambda text: None, str(switch))["x-3"]["square"]
        == 9
    )


def test_a_process_that_dies_does_not_lose_the_others_for_good(tmp_path):
    found = run_cells(DYING, CELLS, tmp_path, 2, lambda text: None)
    assert "failed" in found["x-3"]
    rest = run_cells(DYING, {name: CELLS[name] for name in ("x-2", "x-5")}, tmp_path, 2, lambda text: None)
    assert [result["square"] for result in rest.values()] == [4, 25]


def test_half_a_file_is_no_result(tmp_path):
    run_cells(SQUARED, CELLS, tmp_path, 1, lambda text: None)
    (tmp_path / "x-2.json").write_text('{"cell": {"x": 2}, "resu')
    assert run_cells(SQUARED, CELLS, tmp_path, 1, lambda text: None)["x-2"]["square"] == 4
    assert not [name for name in os.listdir(tmp_path) if name.endswith(".tmp")]
