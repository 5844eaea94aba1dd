"""The manifest of a film, and the error of one line for an entry that it does not understand."""

from pathlib import Path

import pytest
from commands import refuses
from refusals import refused

from mcdenoise.film import read_film
from mcdenoise.shot import ShotSettings

GOOD = """
[every]
model = "joint_bilateral"
alpha-min = 0.2

[[shot]]
name = "010 \\u00e4\\n"
input = "renders/010"
frames = "0-3"

[[shot]]
name = "020"
input = ["a_####.exr", "b_####.exr"]
alpha_min = 1
weights = "mine.safetensors"
map = "albedo=RGBA.diff"
anti_lag = false
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "film.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_manifest_says_what_to_denoise_and_how(tmp_path: Path) -> None:
    first, second = read_film(write(tmp_path, GOOD), ShotSettings(threads=1))
    assert first.name == "010 ä\n"
    assert first.inputs == (tmp_path / "renders/010",)
    assert first.settings == ShotSettings("joint_bilateral", threads=1, alpha_min=0.2, frames="0-3")
    assert second.inputs == (tmp_path / "a_####.exr", tmp_path / "b_####.exr")
    # Numbers may be whole, single texts are lists of one, and paths lie beside the manifest.
    assert second.settings.alpha_min == 1.0
    assert isinstance(second.settings.alpha_min, float)
    assert second.settings.map == ("albedo=RGBA.diff",)
    assert second.settings.weights == tmp_path / "mine.safetensors"
    assert second.settings.anti_lag is False


def test_a_users_model_is_named_by_the_caller_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = '[[shot]]\nname="a"\ninput="b"\n'
    (shot,) = read_film(write(tmp_path, text), ShotSettings("mine.py:make(gain=2)"))
    assert shot.settings.model == f"{tmp_path}/mine.py:make(gain=2)"
    for model in (
        "mine.py:make",
        "os:system(command=ls)",
        "a(1)/mine.py:make",
        " os:system",
        "os:x.safetensors(y=1)/m:f",
    ):
        for manifest in (f'{text}model="{model}"', f'{text}[every]\nmodel="{model}"'):
            assert "a file names no code" in refused(read_film, write(tmp_path, manifest))


def test_a_pattern_names_shots_by_what_it_leaves_open(tmp_path: Path) -> None:
    for name in ("s1/010/beauty", "s1/020/beauty", "s2/010/beauty"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "s2/020").write_text("no folder")
    shots = read_film(tmp_path / "s*" / "0*" / "beauty", ShotSettings("noisy"))
    assert [shot.name for shot in shots] == ["s1_010", "s1_020", "s2_010"]
    assert shots[2].inputs == (tmp_path / "s2/010/beauty",)
    assert {shot.settings.model for shot in shots} == {"noisy"}
    assert [shot.name for shot in read_film(tmp_path / "s1")] == ["s1"]
    (first, *_) = read_film(write(tmp_path, 'shots = "s*/0*/beauty"\n[every]\nalpha_min = 0.5\n'))
    assert (first.name, first.inputs, first.settings.alpha_min) == ("s1_010", (tmp_path / "s1/010/beauty",), 0.5)


SHOT = '[[shot]]\nname = "a"\ninput = "b"\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[shot]\nname = 'a'", "$.shot"),
        ("[[shot]\n", "found: "),
        (SHOT + "[shotz]\n", "shotz"),
        (SHOT.replace("[[shot]]", "shots = '*'\n[[shot]]"), "both or none"),
        ("[every]\nshots = '*'\n", "'shots' in [every]"),
        ("every = 1\n" + SHOT, "$.every"),
        ('[[shot]]\ninput = "b"', "shot 1: expected 'name'"),
        ('[[shot]]\nname = "a"', "shot 1: expected 'name', a text, and 'input'"),
        ('[[shot]]\nname = "a"\ninput = [1]', "and 'input'"),
        ('[[shot]]\nname = "a"\ninput = []', "and 'input'"),
        ('[[shot]]\nname = "../a"\ninput = "b"', "expected a name that a folder can have"),
        ('[[shot]]\nname = "film.json"\ninput = "b"', "not one of film.html, film.json"),
        (f'[[shot]]\nname = "{"a" * 300}"\ninput = "b"', "expected a name that a folder can have"),
        (SHOT + SHOT.replace('"a"', '"A"'), "expected a name of its own for each shot, found 'A' twice"),
        (SHOT + "modle = 'x'", "found 'modle'; did you mean model?"),
        (SHOT + "out = 'x'", "expected a setting of `mcdenoise denoise`, found 'out'"),
        (SHOT + "alpha_min = 'small'", "shot 1 'a': Expected `float | null`, got `str` - at `$.alpha_min`"),
        (SHOT + "alpha_min = 2.0", "shot 1 'a': --alpha-min: expected in (0, 1], found 2.0"),
        (SHOT + "tile = true", "`$.tile`"),
        (SHOT + "alpha = 1", "`$.alpha`"),
        (SHOT + "precision = 'exact'", "'exact' - at `$.precision`"),
        (SHOT + "map = [1]", "`$.map[0]`"),
        (SHOT + "frames = '3-1'", "shot 1 'a': frames: expected numbers and ascending ranges"),
        (SHOT + "budget_ms = 5.0\nmodel = 'noisy'", "expected no --model or --weights: they choose it"),
        (SHOT + "preview_fps = 5.0", "expected together with --preview"),
    ],
)
def test_invalid_manifests_are_refused_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    path, out = write(tmp_path, text), tmp_path / "out"
    message = refuses("film", path, "-o", out)
    assert message.startswith(f"mcdenoise film: {path}")
    assert expected in message
    assert not out.exists()


@pytest.mark.parametrize("options", [["--piece", "-1"], ["--workers", "0"]], ids=" ".join)
def test_bad_options(tmp_path: Path, options: list[str]) -> None:
    assert f"{options[0]}: " in refuses("film", write(tmp_path, SHOT), "-o", tmp_path / "out", *options)
