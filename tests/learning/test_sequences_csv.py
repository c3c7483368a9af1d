"""`Sequences` from CSV files: what is cut where, and what each bad file says."""

import csv
import os
import warnings

import numpy as np
import pytest

from beliefgym.learning import Sequences
from beliefgym.learning.sequences_csv import from_csv, to_csv


@pytest.fixture
def write(tmp_path):
    """Write text to a file and return its path."""

    def written(text, name="run.csv", encoding="utf-8"):
        path = tmp_path / name
        path.write_text(text, encoding=encoding)
        return path

    return written


def read_silently(path, **options):
    """`from_csv` where any warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return from_csv(path, **options)


def read_and_listen(path, **options):
    """What `from_csv` reads, and the warnings that it gives."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sequences = from_csv(path, **options)
    assert all(w.category is UserWarning and w.filename == __file__ for w in caught)
    return sequences, [str(w.message) for w in caught]


def rows(header, *lines):
    return "\n".join([header, *lines]) + "\n"


def test_equals_what_numpy_loadtxt_reads(tmp_path):
    path = tmp_path / "run.csv"
    table = np.random.default_rng(0).normal(size=(50, 4))
    np.savetxt(path, table, delimiter=",", header="x,u,y,r", comments="", fmt="%.17g")
    oracle = np.loadtxt(path, delimiter=",", skiprows=1)
    sequences = read_silently(path, observations=["y", "x"], actions="u", rewards="r")
    assert sequences.lengths.tolist() == [49]
    np.testing.assert_array_equal(sequences.observations[0], oracle[:, [2, 0]])
    np.testing.assert_array_equal(sequences.actions[0], oracle[:-1, [1]])
    np.testing.assert_array_equal(sequences.rewards[0], oracle[:-1, 3])
    assert sequences.observation_names == ("y", "x")
    assert sequences.action_names == ("u",)
    assert dict(sequences.metadata) == {"source": ["run.csv"], "episode_labels": ["run.csv"]}


def test_more_rows_than_one_chunk_equal_what_numpy_loadtxt_reads(tmp_path):
    path = tmp_path / "run.csv"
    table = np.random.default_rng(0).normal(size=(2503, 2))
    np.savetxt(path, table, delimiter=",", header="x,u", comments="", fmt="%.17g")
    sequences = read_silently(path, observations="x", actions="u")
    np.testing.assert_array_equal(sequences.observations[0, :, 0], table[:, 0])
    np.testing.assert_array_equal(sequences.actions[0, :, 0], table[:-1, 1])


def test_labels_make_trajectories_and_the_last_action_of_each_is_dropped(write):
    path = write(rows("trial,x,u,r", "a,0,10,1", "a,1,11,2", "a,2,,", "b 2,5,15,3", "b 2,7,17,4"))
    sequences = read_silently(path, observations="x", actions="u", rewards="r", episode="trial")
    assert sequences.lengths.tolist() == [2, 1]
    assert sequences.observations[..., 0].tolist() == [[0, 1, 2], [5, 7, 0]]
    assert sequences.actions[..., 0].tolist() == [[10, 11], [15, 0]]
    assert sequences.rewards.tolist() == [[1, 2], [3, 0]]
    assert sequences.metadata["episode_labels"] == ["a", "b 2"]
    assert not sequences.terminated.any()


def test_without_rewards_and_actions(write):
    sequences = read_silently(write(rows("x", "1", "2")), observations="x")
    assert sequences.n_act == 0
    assert sequences.rewards.tolist() == [[0]]


def test_patterns_take_columns_in_the_order_of_the_header_and_leave_out_named_ones(write):
    path = write(rows("t,joint_2,u,joint_1,joint_10,", "0,1,2,3,4,9", "1,5,6,7,8,9"))
    assert read_silently(path, observations="joint_*").observation_names == ("joint_2", "joint_1", "joint_10")
    assert read_silently(path, observations=["joint_1", "joint_?"]).observation_names == (
        "joint_1",
        "joint_2",
    )
    everything = read_silently(path, observations="*", actions="u", time="t")
    assert everything.observation_names == ("joint_2", "joint_1", "joint_10")


def test_a_column_name_with_the_signs_of_a_pattern_is_meant_literally(write):
    path = write(rows("angle[rad],angler", "0,1", "2,3"))
    assert read_silently(path, observations="angle[rad]").observation_names == ("angle[rad]",)


def test_spreadsheet_exports_are_read(write):
    """Byte order mark, semicolons, quotes, spaces, Windows line ends, a blank line at the end."""
    path = write('"x"; y \r\n 1 ;"2"\r\n3; 4e0\r\n\r\n', encoding="utf-8-sig")
    sequences = read_silently(path, observations=["x", "y"], delimiter=";")
    assert sequences.observations[0].tolist() == [[1, 2], [3, 4]]


def test_dt_is_the_median_step_and_survives_rounding(write):
    path = write(rows("t,x", *(f"{1e6 + 0.02 * i:.3f},{i}" for i in range(40))))
    assert read_silently(path, observations="x", time="t").metadata["dt"] == pytest.approx(0.02, rel=1e-6)
    path = write(rows("t,x", "0,1", "1,2", "10,3"))  # of the two middle steps the smaller
    with pytest.warns(UserWarning, match="1 of 2 steps"), pytest.warns(UserWarning, match="dropped 1"):
        assert from_csv(path, observations="x", time="t").metadata["dt"] == 1.0


def test_a_gap_in_time_cuts_the_trajectory(write):
    path = write(rows("t,x,u", "0,0,10", "0.1,1,11", "0.2,2,12", "0.5,5,15", "0.6,6,16", "0.7,7,17"))
    sequences, told = read_and_listen(path, observations="x", actions="u", time="t")
    assert told == [
        "1 of 5 steps in time are gaps, more than 0.01 dt away from dt = 0.1; the first at "
        f"{path}, line 4, from 0.2 to 0.5 (line 5); trajectories are cut there; raise time_tolerance where the "
        "clock jitters"
    ]
    assert sequences.observations[..., 0].tolist() == [[0, 1, 2], [5, 6, 7]]
    assert sequences.actions[..., 0].tolist() == [[10, 11], [15, 16]]
    assert sequences.metadata["episode_labels"] == ["run.csv", "run.csv"]
    assert sequences.metadata["dt"] == 0.1


def test_a_gap_in_time_can_be_an_error(write):
    path = write(rows("t,x", "0,0", "0.1,1", "0.2,2", "0.5,5"))
    with pytest.raises(
        ValueError,
        match=r"run\.csv, line 4: expected time steps of dt = 0\.1 within 0\.01 dt, got one from 0\.2 to 0\.5 "
        r"\(line 5\); raise time_tolerance, or pass gaps='split'",
    ):
        from_csv(path, observations="x", time="t", gaps="error")


def test_the_tolerance_decides_what_is_a_gap(write):
    path = write(rows("t,x", "0,0", "1,1", "2.05,2", "3.05,3"))
    with pytest.warns(UserWarning, match="1 of 3 steps in time are gaps, more than 0.04 dt away"):
        assert len(from_csv(path, observations="x", time="t", time_tolerance=0.04)) == 2
    assert len(read_silently(path, observations="x", time="t", time_tolerance=0.06)) == 1


@pytest.mark.parametrize(("again", "told"), [("0.1", "0.1 after 0.1"), ("0.05", "0.05 after 0.1")])
def test_time_that_repeats_or_goes_back_is_an_error(write, again, told):
    path = write(rows("t,x", "0,0", "0.1,1", f"{again},2"))
    with pytest.raises(
        ValueError,
        match=rf"run\.csv, line 4: expected the time to increase within a trajectory, got {told} \(line 3\)",
    ):
        from_csv(path, observations="x", time="t")


def test_time_that_goes_back_across_a_missing_row_is_an_error(write):
    path = write(rows("t,x", "0,0", "0.1,1", ",", "0.1,2"))
    with pytest.raises(ValueError, match=r"line 5: expected the time to increase.* \(line 3\)"):
        from_csv(path, observations="x", time="t")


def test_interleaved_recordings_are_separated_by_label_where_time_orders_them(write):
    path = write(rows("who,t,x", "a,0,0", "b,0,10", "a,1,1", "b,1,11", "b,2,12", "a,2,2"))
    sequences = read_silently(path, observations="x", episode="who", time="t")
    assert sequences.observations[..., 0].tolist() == [[0, 1, 2], [10, 11, 12]]
    with pytest.raises(
        ValueError, match=r"line 4: expected the rows of trajectory 'a' to stand together.*; pass time="
    ):
        from_csv(path, observations="x", episode="who")


@pytest.mark.parametrize("cell", ["", "NaN", " na ", "N/A", "null", "None", "inf", "-inf"])
def test_a_missing_observation_cuts_the_trajectory_around_its_row(write, cell):
    path = write(rows("x,y,u", "0,0,10", "1,1,11", f"2,{cell},12", "3,3,13", "4,4,14"))
    sequences, told = read_and_listen(path, observations=["x", "y"], actions="u")
    assert told == [
        f"1 missing numbers in 1 of 5 rows, the first at {path}, line 4, column 'y'; trajectories are cut there"
    ]
    assert sequences.observations[..., 0].tolist() == [[0, 1], [3, 4]]
    assert sequences.actions[..., 0].tolist() == [[10], [13]]
    with pytest.raises(
        ValueError,
        match=r"line 4, column 'y': expected a finite number, got (a missing one|-?inf); repair it",
    ):
        from_csv(path, observations=["x", "y"], actions="u", missing="error")


@pytest.mark.parametrize("column", ["u", "r"])
def test_a_missing_action_or_reward_ends_the_episode_but_keeps_its_observation(write, column):
    cells = {"u": ",5", "r": "5,"}[column]
    path = write(rows("x,u,r", "0,1,2", f"1,{cells}", "2,3,4", "3,,"))
    with pytest.warns(UserWarning, match=rf"1 missing numbers in 1 of 4 rows.*line 3, column '{column}'"):
        sequences = from_csv(path, observations="x", actions="u", rewards="r")
    assert sequences.observations[..., 0].tolist() == [[0, 1], [2, 3]]
    assert sequences.actions[..., 0].tolist() == [[1], [3]]
    assert sequences.rewards.tolist() == [[2], [4]]


def test_the_first_of_several_faults_is_the_first_in_the_file(write):
    path = write(rows("who,t,x", "a,0,0", "b,0,10", "b,1,", "a,1,", "a,2,2", "b,2,12", "b,3,13", "a,3,3"))
    _, told = read_and_listen(path, observations="x", episode="who", time="t", min_steps=0)
    assert told == [
        f"2 missing numbers in 2 of 8 rows, the first at {path}, line 4, column 'x'; trajectories are cut there"
    ]


def test_a_blank_line_inside_a_file_cuts_the_trajectory(write):
    path = write("x\n0\n1\n\n\n2\n3\n\n")
    with pytest.warns(
        UserWarning, match=r"1 missing numbers in 1 of 5 rows, the first at .*line 4, column 'x'"
    ):
        sequences = from_csv(path, observations="x")
    assert sequences.observations[..., 0].tolist() == [[0, 1], [2, 3]]
    labelled = write("who,x\na,0\na,1\n\nb,2\nb,3\n")
    assert len(read_silently(labelled, observations="x", episode="who")) == 2


def test_short_pieces_are_dropped_by_name(write):
    path = write(rows("who,x", "a,0", "b,1", "b,2", "b,3", "c,4", "c,5", "d,6", "e,7"))
    sequences, told = read_and_listen(path, observations="x", episode="who", min_steps=2)
    assert told == [
        "dropped 4 of 5 episodes, shorter than min_steps=2 steps: 'a' lines 2 to 2, 'c' lines 6 to 7, 'd' lines "
        "8 to 8 and 1 more"
    ]
    assert sequences.metadata["episode_labels"] == ["b"]
    every = read_silently(path, observations="x", episode="who", min_steps=0)
    assert every.lengths.tolist() == [0, 2, 1, 0, 0]


def test_nothing_left_says_why(write):
    path = write(rows("x,y", "0,", "1,", "2,"))
    with pytest.raises(
        ValueError,
        match=r"expected an episode of at least 1 steps, got none of 3 rows; 3 missing numbers in 3 of 3 rows, the "
        r"first at .*line 2, column 'y'.*Leave out columns that have no numbers",
    ):
        from_csv(path, observations=["x", "y"])


def test_constant_columns_are_kept_and_named(write):
    path = write(rows("x,y,u,v", "0,7,1,2", "1,7,1,3", "2,7,5,4"))  # the last row's u is no action of a step
    sequences, told = read_and_listen(path, observations=["x", "y"], actions=["u", "v"])
    assert told == ["constant columns, which carry no information to a model: y, u"]
    assert sequences.n_obs == 2


def test_several_files_never_join(write):
    first = write(rows("who,x", "a,0", "a,1"), "one.csv")
    second = write(rows("x,who", "2,a", "3,a"), "two.csv")  # another order of the same columns
    sequences = read_silently([first, str(second)], observations="x", episode="who")
    assert sequences.observations[..., 0].tolist() == [[0, 1], [2, 3]]
    assert sequences.metadata["source"] == ["one.csv", "two.csv"]
    assert sequences.metadata["episode_labels"] == ["one.csv: a", "two.csv: a"]
    third = write(rows("who,x", "a,0", "a,oops"), "three.csv")
    with pytest.raises(ValueError, match=r"three\.csv, line 3, column 'x': .* got 'oops'"):
        from_csv([first, third], observations="x", episode="who")


@pytest.mark.parametrize("text", ["fast", "1,5", "1_5", "0x10", "2024-01-01"])
def test_text_that_is_no_number_names_its_cell(write, text):
    lines = [f"{i};{i}" for i in range(1500)]
    path = write(rows("x;y", *lines, f"7;{text}"))
    with pytest.raises(
        ValueError, match=rf"run\.csv, line 1502, column 'y': expected a number.*, got '{text}'; repair"
    ):
        from_csv(path, observations=["x", "y"], delimiter=";")


def test_lines_count_as_in_an_editor_after_a_cell_of_several_lines(write):
    path = write('x,note\n1,"two\nlines"\n2,plain\noops,plain\n')
    with pytest.raises(ValueError, match=r"run\.csv, line 5, column 'x'"):
        from_csv(path, observations="x")


def test_unknown_and_misused_columns(write):
    path = write(rows("angle,torque,angle2,t,t", "0,0,0,0,0", "1,1,1,1,1"))
    with pytest.raises(
        ValueError, match=r"no column 'angel'; did you mean 'angle'\? \(it has \['angle', 'torque'"
    ):
        from_csv(path, observations="angel")
    with pytest.raises(ValueError, match=r"no column 'joint_\*'"):
        from_csv(path, observations="joint_*")
    with pytest.raises(ValueError, match=r"no column 'reward'"):
        from_csv(path, observations="angle", rewards="reward")
    with pytest.raises(ValueError, match="column 'torque': expected one use, got several"):
        from_csv(path, observations=["angle", "torque"], actions="torque")
    with pytest.raises(ValueError, match=r"run\.csv: expected one column 't', got 2; rename"):
        from_csv(path, observations="angle", time="t")
    with pytest.raises(ValueError, match="observations: expected at least one column, got none"):
        from_csv(path, observations=())
    with pytest.raises(ValueError, match="the header is one cell: pass the delimiter"):
        from_csv(write("x;y\n1;2\n"), observations="x")


def test_files_that_are_no_table(write, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file .*nowhere\.csv; expected a CSV file"):
        from_csv(tmp_path / "nowhere.csv", observations="x")
    with pytest.raises(ValueError, match="expected at least one CSV file, got none"):
        from_csv([], observations="x")
    with pytest.raises(ValueError, match="expected a header row of column names, got an empty file"):
        from_csv(write(""), observations="x")
    with pytest.raises(ValueError, match="expected rows below the header, got none"):
        from_csv(write("x\n\n"), observations="x")
    with pytest.raises(ValueError, match=r"line 3: expected 2 cells as in the header, got 3; repair the row"):
        from_csv(write("x,y\n1,2\n1,2,3\n"), observations="x")
    with pytest.raises(
        ValueError, match=r"line 3, column 'who': expected the label of a trajectory in every row"
    ):
        from_csv(write("who,x\na,1\n,2\n"), observations="x", episode="who")
    with pytest.raises(ValueError, match=r"expected CSV text in UTF-8, got .*codec can't decode"):
        from_csv(write("x,größe\n1,2\n", encoding="latin-1"), observations="x")
    with pytest.raises(ValueError, match=r"expected CSV text in UTF-8, got unexpected end of data"):
        from_csv(write('x\n1\n"2\n'), observations="x")


@pytest.mark.parametrize(
    ("option", "told"),
    [
        ({"gaps": "cut"}, "gaps: expected 'split' or 'error', got 'cut'"),
        ({"missing": "drop"}, "missing: expected 'split' or 'error', got 'drop'"),
        ({"time_tolerance": -0.1}, "time_tolerance: expected a fraction of dt from 0 to 1, got -0.1"),
        ({"min_steps": 1.5}, "min_steps: expected a whole number of at least 0, got 1.5"),
    ],
)
def test_bad_options(write, option, told):
    with pytest.raises(ValueError, match=told):
        from_csv(write(rows("x", "1", "2")), observations="x", **option)


@pytest.mark.parametrize("dt", [None, 0.1])
def test_round_trip(tmp_path, dt):
    rng = np.random.default_rng(0)
    sequences = Sequences(
        rng.normal(size=(3, 6, 2)),
        rng.normal(size=(3, 5, 1)),
        rng.normal(size=(3, 5)),
        lengths=[5, 0, 3],
        observation_names=("x", 'angle, "θ"'),
        metadata={} if dt is None else {"dt": dt},
    )
    path = to_csv(sequences, tmp_path / "run.csv")
    assert path == tmp_path / "run.csv"
    assert os.listdir(tmp_path) == ["run.csv"]
    again = read_silently(
        path,
        observations=["x", 'angle, "θ"'],
        actions="action_*",
        rewards="reward",
        episode="episode",
        time="step" if dt is None else "time",
        min_steps=0,
    )
    np.testing.assert_array_equal(again.lengths, sequences.lengths)
    for name in ("observations", "actions", "rewards"):
        np.testing.assert_array_equal(getattr(again, name), getattr(sequences, name))
    assert again.metadata["dt"] == (dt or 1.0)
    assert again.metadata["episode_labels"] == ["0", "1", "2"]


def test_what_is_written(tmp_path):
    sequences = Sequences([[[0.1], [2.0]]], [[[3.0]]], [[4.0]], metadata={"dt": 0.5})
    with open(to_csv(sequences, tmp_path / "run.csv"), newline="") as file:
        assert list(csv.reader(file)) == [
            ["episode", "step", "time", "observation_0", "action_0", "reward"],
            ["0", "0", "0.0", "0.1", "3.0", "4.0"],
            ["0", "1", "0.5", "2.0", "", ""],
        ]


def test_writing_fails_before_it_begins(tmp_path):
    sequences = Sequences([[[0.1], [2.0]]], [[[3.0]]], [[4.0]], action_names=("step",))
    with pytest.raises(ValueError, match=r"expected each column name once, got \['step'\] more than once"):
        to_csv(sequences, tmp_path / "run.csv")
    with pytest.raises(FileNotFoundError, match=r"the folder .*missing does not exist; create it first"):
        to_csv(sequences, tmp_path / "missing" / "run.csv")
    assert os.listdir(tmp_path) == []
