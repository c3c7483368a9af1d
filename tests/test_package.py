"""The package as a user installs it: its modules, its symbolic links, its names, and its two commands."""

import re
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import beliefgym

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("learning", "envs", "wrappers", "agents", "scripts")
in_checkout = pytest.mark.skipif(
    not (ROOT / "pyproject.toml").exists(), reason="not in a checkout of the project"
)


@in_checkout
def test_a_wheel_holds_every_module_and_data_file_of_the_tree(tmp_path):
    copy = tmp_path / "copy"  # so that what an earlier build left in the tree does not count
    copy.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "src", *FOLDERS):
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
            )
        else:
            shutil.copy(ROOT / name, copy / name)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "-q",
        "-w",
        tmp_path,
        copy,
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    tree = {
        f"beliefgym/{path.relative_to(ROOT)}"
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".json", ".safetensors") and "__pycache__" not in path.parts
    }
    tree |= {f"beliefgym/{name}" for name in ("__init__.py", "__main__.py", "_version.py", "py.typed")}
    assert packed == tree


@in_checkout
def test_the_links_are_relative_and_lead_to_the_folders():
    for folder in FOLDERS:
        link = ROOT / "src" / "beliefgym" / folder
        assert link.is_symlink()
        assert str(link.readlink()) == f"../../{folder}"


def test_a_checkout_without_its_links_says_so(tmp_path):
    package = tmp_path / "beliefgym"
    package.mkdir()
    for name in ("__init__.py", "_version.py"):
        (package / name).write_text((Path(beliefgym.__file__).with_name(name)).read_text())
    for folder in FOLDERS:
        (package / folder).write_text(f"../../{folder}")  # what git writes without symbolic links
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import beliefgym"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "this checkout has lost its symbolic links" in done.stderr


def test_every_public_name_is_there_and_documented():
    for folder in FOLDERS[:4]:
        module = __import__(f"beliefgym.{folder}", fromlist=["__all__"])
        assert list(module.__all__) == sorted(module.__all__, key=lambda name: (not name.isupper(), name))
        for name in module.__all__:
            thing = getattr(module, name)
            assert (thing.__doc__ or "").strip(), f"beliefgym.{folder}.{name} has no docstring"


@in_checkout
def test_version_constraints_and_ranges_agree():
    assert version("beliefgym") == beliefgym.__version__
    pins = dict(re.findall(r"^([A-Za-z0-9_.-]+)==([^\s]+)$", (ROOT / "constraints.txt").read_text(), re.M))
    names = {name.lower().replace("_", "-") for name in pins}
    for line in re.findall(r'^    "([a-z0-9-]+)[><=!]', (ROOT / "pyproject.toml").read_text(), re.M):
        assert line in names, f"{line} is not pinned in constraints.txt"


@in_checkout
def test_the_readme_names_the_two_commands_and_make_help_lists_them():
    first_screen = "\n".join((ROOT / "README.md").read_text().splitlines()[:40])
    assert "make leaderboard" in first_screen
    assert "make test" in first_screen
    listed = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True).stdout
    for target in ("install", "leaderboard", "test", "benchmark"):
        assert re.search(rf"^{target} ", listed, re.M), listed


def test_stepping_environments_imports_neither_scikit_learn_nor_torch():
    code = (
        "import sys, beliefgym, gymnasium; gymnasium.make('beliefgym/Pendulum-v0').reset(); "
        "assert not {'sklearn', 'torch'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_name_that_learning_does_not_have_is_told():
    import beliefgym.learning as learning

    wrong = "Ridgee"
    with pytest.raises(AttributeError, match=r"module 'beliefgym\.learning' has no attribute 'Ridgee'"):
        getattr(learning, wrong)
    assert "LaggedError" in dir(learning)
