"""The README's example on recordings does what it says."""

import re
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from beliefgym.learning import DataAsDemonstrator
from beliefgym.scripts.reproductions.dad_data import pendulum

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.skipif(not README.exists(), reason="the README lies in a checkout only")
def test_five_lines_from_recorded_arrays_to_a_forecast(tmp_path, monkeypatch):
    (example,) = (
        block
        for block in re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
        if "DataAsDemonstrator" in block
    )
    _, body = example.split("\n\n")
    assert len(body.strip().splitlines()) == 5
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    np.save("runs.npy", pendulum(0, n=100, n_steps=120).observations)
    names: dict = {}
    exec(example, names)
    recorded, forecast = names["test"].observations[0, :101], names["forecast"]
    assert forecast.shape == (101, 3)
    assert np.sqrt(np.square(forecast - recorded).mean() / np.square(recorded).mean()) < 0.02
    plain = DataAsDemonstrator(n_iterations=0).fit(names["train"])
    # 0.0037 against 0.0164 where it was measured
    assert names["model"].errors(names["test"]).mean < 0.5 * plain.errors(names["test"]).mean
    assert len(names["plt"].gca().lines) == 6
    names["plt"].savefig("forecast.png")
    names["plt"].close("all")
