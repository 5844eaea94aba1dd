"""Shots in pieces: everything is made once, with enough frames before it, wherever one begins again."""

import math
import random
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from shots import frame, pixels, write_shot
from torch.utils import _pytree as pytree

from mcdenoise import ops
from mcdenoise.denoiser import Denoiser
from mcdenoise.film.manifest import Shot
from mcdenoise.film.work import Found, look, make
from mcdenoise.metrics import smape_linear
from mcdenoise.models import create_model, list_models
from mcdenoise.models._wrapper import frames_remembered
from mcdenoise.shot import ShotSettings

SHOT = Shot("s", (), ShotSettings())


@pytest.mark.parametrize("seed", range(5))
def test_every_missing_frame_is_made_once_with_the_frames_before_it(seed: int) -> None:
    g = random.Random(seed)
    numbers = sorted(g.sample(range(200), g.randint(1, 120)))
    missing = {number for number in numbers if g.random() < g.choice([0.02, 0.5, 1.0])}
    length, overlap = g.choice([0, 1, 7, 30]), g.choice([None, 0, 1, 5, 40])
    pieces = Found(SHOT, tuple(numbers), {}, overlap, frozenset(missing)).pieces(length)
    made = [number for _, written in pieces for number in written]
    assert missing <= set(made)
    assert len(made) == len(set(made))
    for computed, written in pieces:
        places = [numbers.index(number) for number in computed]
        # One after the other, without a gap, and nothing behind the last.
        assert places == list(range(places[0], places[-1] + 1))
        assert computed[-len(written) :] == written
        assert missing.intersection(written)
        assert len(written) <= length or length == 0 or overlap is None
        for number in written:
            before = numbers.index(number) - places[0]
            assert before >= (math.inf if overlap is None else overlap) or places[0] == 0


def test_pieces_do_not_depend_on_what_is_missing() -> None:
    found = Found(SHOT, tuple(range(100)), {}, 5, frozenset(range(100)))
    whole = found.pieces(30)
    assert [(computed[0], written[0], written[-1]) for computed, written in whole] == [
        (0, 0, 24),
        (20, 25, 49),
        (45, 50, 74),
        (70, 75, 99),
    ]
    for piece in whole:
        assert replace(found, missing=frozenset(piece[1][3:7])).pieces(30) == [piece]


def test_an_average_remembers_what_its_alpha_says() -> None:
    model = create_model("accumulated", alpha_min=0.25)
    frames = frames_remembered(model, 0.01)
    assert 0.75**frames <= 0.01 < 0.75 ** (frames - 1)
    assert frames_remembered(create_model("noisy"), 0.01) == 0
    assert frames_remembered(create_model("accumulated", alpha_min=1.0), 0.01) == 1
    # Each remembers what the one before it remembered.
    assert frames_remembered(create_model("bmfr", alpha_min=0.5, second_alpha=0.5, taa_alpha=0.5), 0.01) == 3 * 7


@pytest.mark.parametrize("name", list_models())
def test_a_method_that_keeps_a_state_says_how_long(name: str) -> None:
    model = create_model(name)
    remembered = frames_remembered(model, 0.01)
    if not model.needs.buffers <= frame(0, 32, 32, 0).buffers:
        pytest.skip("the frame has not what it needs")
    denoiser = Denoiser(model)
    # Compiling kernels would take longer than all else.
    with ops.use("torch"):
        for number in range(2):
            denoiser(frame(number, 32, 32, 0).replace(motion=torch.zeros(1, 2, 32, 32)))
    keeps = [leaf for leaf in pytree.tree_leaves(denoiser._state) if leaf is not None]
    assert bool(keeps) == (remembered != 0)


@pytest.fixture(scope="module")
def long_shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shot(tmp_path_factory.mktemp("long") / "shot", 24, width=48, height=32)


@pytest.mark.parametrize(
    "settings",
    [ShotSettings("accumulated", alpha_min=0.4, threads=1), ShotSettings("noisy", threads=1)],
    ids=lambda settings: str(settings.model),
)
def test_a_shot_in_pieces_is_the_whole_one_up_to_the_joint(
    long_shot: Path, tmp_path: Path, settings: ShotSettings
) -> None:
    shot = Shot("long", (long_shot,), settings)
    images = {}
    for name, length in (("whole", 0), ("cut", 12)):
        pieces = look(shot, tmp_path / name).pieces(length)
        assert len(pieces) == (2 if length else 1)
        for piece in pieces:
            assert not make(shot, tmp_path / name, piece)
        images[name] = pixels(tmp_path / name / shot.name)
    errors = {
        int(file.removeprefix("denoised").removesuffix(".exr")): float(
            smape_linear(*(torch.from_numpy(images[name][file]).permute(2, 0, 1)[None] for name in images))
        )
        for file in images["whole"]
    }
    assert len(errors) == 24
    # The first piece has all frames before it, and a method without a history none to miss.
    assert max(errors[number] for number in range(12)) == 0
    assert max(errors.values()) <= 1e-2
    assert (max(errors.values()) == 0) is (settings.model == "noisy")
