"""Recipes: from nothing to weights by one command, also when it is stopped, and recipes that are refused."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from commands import refuses, run, succeeds
from refusals import refused

from mcdenoise.cli.train import options_of
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.models import describe_weights
from mcdenoise.train import Recipe, Rendering, clean_references

RECIPES = Path(__file__).parents[2] / "recipes"
TINY = RECIPES / "tiny.toml"
WEIGHTS = "wild_small.safetensors"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
    pytest.importorskip("tensorboard", reason="training needs the packages of mcdenoise[train]")
    out = tmp_path_factory.mktemp("recipe") / "run"
    succeeds("train", "--recipe", TINY, "-o", out)
    return out


def changed(tmp_path: Path, old: str, new: str) -> Path:
    text = TINY.read_text()
    assert old in text
    path = tmp_path / "changed.toml"
    path.write_text(text.replace(old, new))
    return path


def renderings(data: Path) -> dict[Path, int]:
    return {path.relative_to(data): path.stat().st_mtime_ns for path in data.rglob("*.exr")}


def test_from_nothing_to_weights(trained: Path) -> None:
    folders = [json.loads(path.read_text())["seeds"] for path in (trained / "data").glob("*/finished.json")]
    assert sorted(folders) == ["0-1", "2"]
    said = json.loads((trained / "data.json").read_text())
    assert [each["name"] for each in said["sequences"]] == ["random0000", "random0001"]
    assert [each["noise_seeds"] for each in said["sequences"]] == [2, 2]
    assert [each["name"] for each in said["validation_sequences"]] == ["random0002"]
    assert describe_weights(trained / WEIGHTS)["recipe"] == said["recipe"]

    before = renderings(trained / "data"), (trained / WEIGHTS).stat().st_mtime_ns
    printed = succeeds("train", "--recipe", TINY, "-o", trained)
    assert (renderings(trained / "data"), (trained / WEIGHTS).stat().st_mtime_ns) == before
    errors, expected, weights = printed.splitlines()
    scores = json.loads((trained / "log.jsonl").read_text().splitlines()[-1])["validation"]
    assert errors.startswith(f"validation  smape {scores['smape']:.4f}  psnr {scores['psnr']:.4f}")
    assert expected == f"expected a smape of at most 0.193 + 0.01, found {scores['smape']:.4f}: met"
    assert weights == str(trained / WEIGHTS)


def test_a_run_that_was_killed_while_it_rendered_goes_on(trained: Path, tmp_path: Path) -> None:
    out, data = tmp_path / "run", tmp_path / "data"
    shutil.copytree(trained / "data", data)
    (frame,) = data.glob("*/random0000/inputs/color2.exr")
    (frame.parents[2] / "finished.json").unlink()
    frame.unlink()
    before = renderings(data)
    succeeds("train", "--recipe", TINY, "-o", out, "--data", data)
    after = renderings(data)
    assert after.keys() - before.keys() == {frame.relative_to(data)}
    assert {path: after[path] for path in before} == before
    assert (out / "data.json").read_bytes() == (trained / "data.json").read_bytes()
    assert describe_weights(out / WEIGHTS)["sha256"] == describe_weights(trained / WEIGHTS)["sha256"]


def test_another_recipe_does_not_go_on_with_a_run(trained: Path, tmp_path: Path) -> None:
    before = renderings(trained / "data")
    recipe = changed(tmp_path, "steps = 12", "steps = 13")
    status, _, said = run("train", "--recipe", recipe, "-o", trained)
    assert status == 2
    assert "config.json: expected steps=13 as in this run, found steps=12" in said
    # Other data for the same training, as if they were rendered already.
    recipe, data = changed(tmp_path, 'seeds = "0-1"', 'seeds = "1"'), tmp_path / "data"
    shutil.copytree(trained / "data", data)
    both, one = (Recipe.read(path, options_of("generate")).data[0].folder(data) for path in (TINY, recipe))
    shutil.rmtree(both / "random0000")
    both.rename(one)
    status, _, said = run("train", "--recipe", recipe, "-o", trained, "--data", data)
    assert status == 2
    assert "data.json: expected " in said
    assert renderings(trained / "data") == before


def test_a_folder_with_a_name_is_of_the_options_that_it_was_rendered_with(tmp_path: Path) -> None:
    place, rendered = tmp_path / "shots", list[str]()

    def make(seeds: str, **more: Any) -> list[Path]:
        rendering = Rendering("recipe", {"seeds": seeds, "frames": 3, **more}, clean=False, name="shots")
        return rendering.make(tmp_path, lambda: (place / f"random{seeds}").mkdir() or rendered.append(seeds))

    # The number of threads changes no pixel.
    assert make("1") == make("1", threads=2) == [place / "random1"]
    message = refused(lambda: make("2"))
    assert "'seeds': '2'" in message
    assert "'seeds': '1'" in message
    # One that was damaged, and removed.
    (place / "random1").rmdir()
    assert make("1") == [place / "random1"]
    (place / "finished.json").unlink()
    assert make("2") == [place / "random1", place / "random2"]
    assert rendered == ["1", "1", "2"]


@pytest.mark.parametrize("recipe", sorted(RECIPES.glob("*.toml")), ids=lambda path: path.stem)
def test_the_recipes_can_be_read(recipe: Path) -> None:
    found = Recipe.read(recipe, options_of("generate"))
    assert found.data
    assert found.validation


def test_the_recipe_that_is_explained(tmp_path: Path) -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[peers]")
    block, runs = re.findall(r"```toml\n(.*?)```", (RECIPES.parent / "training" / "README.md").read_text(), re.DOTALL)
    path = tmp_path / "explained.toml"
    path.write_text(block)
    found = Recipe.read(path, options_of("generate"))
    assert [rendering.clean for rendering in (*found.data, *found.validation)] == [True, False, False]
    path.write_text(block.partition("[expected]")[0] + runs)
    assert [run.name for run in Recipe.read(path, options_of("generate")).runs] == ["K-1", "K-2", "K-3"]
    (one,) = found.runs
    assert (one.name, one.config.steps, one.expected, found.credits) == ("", 5000, (0.1, 0.005), "random*: CC0")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[train]", "[train", "expected a recipe in TOML, found: "),
        ("[train]", "[training]", "unknown field training"),
        ("[train]", "[train]\nseeds = 1", "train: object contains unknown field seeds"),
        ("steps = 12", 'steps = "12"', "train.steps: expected int, got str"),
        ("steps = 12", "steps = true", "train.steps: expected int, got bool"),
        ("steps = 12", "steps = 0", "train.steps: expected int >= 1"),
        ('"wild_small"', '"cascade"', "cascade"),
        ("[[data]]", "[data]", "data: expected array, got object"),
        ('[[data]]\nseeds = "0-1"', '[[data]]\nseed = "0-1"', "unknown field seed; did you mean seeds"),
        ("frames = 3", "frames = 2.5", "[[data]] 1: "),
        ("frames = 3", "frames = 0", "[[data]] 1: --frames: expected at least 1, found 0"),
        ("frames = 3", "folder = '../elsewhere'", ".folder: expected str matching"),
        ('assets = "none"', "assets = 'elsewhere'", "assets: expected one of none, found 'elsewhere'"),
        ("frames = 3", "clean_references = 1", "clean_references: expected bool, got int"),
        ('size = "48x48"\nnoise_seeds = 2', "size = 48", "[[data]] 1: --size: expected WIDTHxHEIGHT"),
        ("tolerance = 0.01", "", "expected: object missing required field tolerance"),
        ("[expected]", "[[run]]\nname = 'a'\n[expected]", "what is expected in each [[run]], found [expected]"),
        ("[expected]", "[[run]]\n[run.expected]", "missing required field name"),
        ("[expected]", "[[run]]\nname = 'a/b'\n[run.expected]", ".name: expected str matching"),
        ("[expected]", "[[run]]\nname = 'a'\n[[run]]\nname = 'a'\n[run.expected]", "each name once, found 'a' again"),
        ("[expected]", "[[run]]\nname = 'a'\nseeds = [1, 1]\n[run.expected]", "each name once, found 'a-1' again"),
        ("[expected]", "[[run]]\nname = 'a'\nseeds = []\n[run.expected]", "seeds: expected array of length >= 1"),
    ],
)
def test_bad_recipes(tmp_path: Path, old: str, new: str, message: str) -> None:
    recipe = changed(tmp_path, old, new)
    # Whatever is wrong, nothing is rendered first.
    said = refuses("train", "--recipe", recipe, "-o", tmp_path / "run", "--data", tmp_path / "data")
    assert said.startswith(f"mcdenoise train: {recipe}: ")
    assert message in said
    assert not list(tmp_path.rglob("*.exr"))


def test_runs_on_the_same_data(trained: Path, tmp_path: Path, out: Path) -> None:
    before = renderings(trained / "data")
    bound = "{ smape = 0.2, tolerance = 0.1 }"
    runs = f"""
[[run]]
name = "as-it-was"
expected = {{ smape = 0.0, tolerance = 1e-9 }}

[[run]]
name = "K"
model = "cascaded"
settings = "cascade=K,width=4"
steps = 1
seeds = [4, 5]
expected = {bound}

[[run]]
name = "other-loss"
loss = "l1_display"
steps = 2
"""
    recipe = tmp_path / "runs.toml"
    recipe.write_text(TINY.read_text().partition("[expected]")[0] + runs)
    command = ["train", "--recipe", recipe, "-o", out, "--data", trained / "data", "--runs"]
    said = succeeds(*command, "K-5", "other-loss")
    assert sorted(path.name for path in out.iterdir()) == ["K-5", "cache", "other-loss"]
    assert renderings(trained / "data") == before
    config = json.loads((out / "other-loss" / "config.json").read_text())
    assert (config["loss"], config["steps"], config["settings"]) == ("l1_display", 2, "")
    about = describe_weights(out / "K-5" / "cascaded.safetensors")
    assert (about["settings"]["cascade"], json.loads((out / "K-5" / "config.json").read_text())["seed"]) == ("K", 5)
    # The expected error is printed for the run that has one.
    assert said.count("expected a smape of at most") == said.count("0.2 + 0.1") == 1
    # A run has the common settings where it states none: this one is the recipe of a single run.
    # Data that another run has rendered are used, and the expected error of weights does not change them.
    status, _, said = run(*command, "as-it-was")
    assert status == 0
    both = [describe_weights(each / WEIGHTS) for each in (trained, out / "as-it-was")]
    assert len({about["sha256"] for about in both}) == len({about["recipe"] for about in both}) == 1
    assert said.splitlines()[-1].startswith("warning: expected a smape of at most 0 + 1e-09, found 0.")
    assert said.endswith(": missed\n")
    expected = "--runs: expected names of the recipe's runs (as-it-was, K-4, K-5, other-loss), found 'P'"
    assert expected in refuses(*command, "P")
    command = ["train", "--recipe", TINY, "-o", tmp_path / "run", "--runs", "K"]
    assert "(a single run without a name), found 'K'" in refuses(*command)


@pytest.mark.parametrize("place", [".", "inputs"])
def test_cleaned_references(small_sequence: Path, tmp_path: Path, place: str) -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[peers]")
    description = small_sequence / "inputs" / "camera.json"
    about = json.loads(description.read_text())
    description.write_text(json.dumps({**about, "reference_spp": {"0": 64}, "reference_noise": {"0": 0.1}}))
    copied = clean_references(small_sequence / place, tmp_path / "out")
    assert copied == tmp_path / "out" / "plane"
    source, cleaned = open_sequence(small_sequence), open_sequence(copied)
    assert cleaned.reference_numbers == source.reference_numbers
    before, after = (dict(sequence.frame(1).items()) for sequence in (source, cleaned))
    assert {name for name in before if not torch.equal(before[name], after[name])} == {"reference"}
    # Facts about the references as rendered are not stated of the filtered ones.
    said = json.loads((copied / "inputs" / "camera.json").read_text())
    assert said == {**about, "reference_filter": "Open Image Denoise, high, clean aux", "source": said["source"]}


def test_references_are_cleaned_anew_if_the_sequence_has_changed(small_sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[peers]")
    (small_sequence / "credits.txt").write_text("chair (Ann, CC0)\n")
    copied = clean_references(small_sequence, tmp_path / "out")
    assert (copied / "credits.txt").read_text() == "chair (Ann, CC0)\n"
    before = {path: path.stat().st_mtime_ns for path in copied.rglob("*")}
    assert clean_references(small_sequence, tmp_path / "out") == copied
    assert {path: path.stat().st_mtime_ns for path in copied.rglob("*")} == before
    inputs = small_sequence / "inputs"
    shutil.copyfile(inputs / "reference0.exr", inputs / "reference1.exr")
    for path in inputs.glob("*3.exr"):
        path.unlink()
    again = open_sequence(clean_references(small_sequence, tmp_path / "out"))
    assert again.numbers == [0, 1, 2]
    assert (copied / "inputs" / "reference1.exr").stat().st_mtime_ns > max(before.values())
    # The sequence itself is no copy, and stays.
    with pytest.raises(InputError, match="expected a copy with clean references"):
        clean_references(small_sequence, small_sequence.parent)
