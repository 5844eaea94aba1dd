"""Images and derivatives of every method, and what commands write, must not change.

``make.py`` creates the digests in float64. The bounds come from their changes by rounding, see
``golden_cases.ALLOWED``. Another test shows that small errors exceed them.
"""

from pathlib import Path

import pytest
import torch
from golden_cases import (
    ALLOWED,
    ALLOWED_EXACT,
    METHODS,
    SMALLEST,
    WAYS,
    Digests,
    change,
    digests,
    golden,
    is_slow,
    precision_of,
    ways_of,
)
from golden_commands import COMMANDS, FOLDERS, LOSSES, PIXELS, losses, said, same, texts, written

from mcdenoise import create_model
from mcdenoise.models import Model

DIGESTS, CHANGES = golden()


def beyond(method: str, way: str, found: Digests) -> list[str]:
    """The parts that differ from those in the file by more than rounding."""
    wrong, precision = [], precision_of(method, way)
    for part, image in found.items():
        key = f"{method}: {WAYS[way].shot.name}: {part}"
        error = change(image, DIGESTS[key])
        for what, factor in ALLOWED.items():
            if precision == "float64":
                allowed = ALLOWED_EXACT
            else:
                # Everything except convolutions is in float32.
                allowed = factor * max(CHANGES[key][precision][what], torch.finfo(torch.float32).eps)
            if not error[what] <= allowed:
                wrong.append(f"{key}: {what} difference {error[what]:.3g}, expected at most {allowed:.3g}")
    return wrong


def differences(method: str, way: str, model: Model | None = None, **settings: object) -> list[str]:
    return beyond(method, way, digests(method, way, precision_of(method, way), model, **settings))


@pytest.mark.parametrize(
    ("method", "way"),
    [
        pytest.param(method, way, marks=[pytest.mark.slow] if is_slow(method, way) else [])
        for method in METHODS
        for way in ways_of(method)
    ],
)
def test_images_agree_with_the_file(method: str, way: str) -> None:
    assert not differences(method, way)


def test_tiles_of_the_still_shot_are_skipped() -> None:
    wrong = differences(SMALLEST, "skipped", keep_all=True)
    assert {message.split(": ")[2] for message in wrong} == {"passed", "reused"}


@pytest.mark.parametrize("way", ["whole", "bfloat16", "gradients"])
def test_small_errors_of_weights_and_histories_are_found(way: str) -> None:
    other = create_model(SMALLEST, pretrained=True)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.mul_(1 + (1e-2 if way == "bfloat16" else 1e-5))
    assert differences(SMALLEST, way, other)
    # In bfloat16 rounding hides it.
    assert way == "bfloat16" or differences(SMALLEST, way, alpha_min=0.6)


def test_the_file_has_every_method_and_is_small() -> None:
    assert {key.partition(":")[0] for key in DIGESTS} == {*METHODS, COMMANDS}
    assert all(digest.isfinite().all() for digest in DIGESTS.values())


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_files_of_a_renderer_are_read_and_written_as_before(folder: Path, tmp_path: Path) -> None:
    assert same(said("inspect", folder), texts()[folder.name])
    found, expected = written(folder, tmp_path / "out"), DIGESTS[f"{COMMANDS}: {folder.name}"]
    assert found.shape == expected.shape
    assert ((found - expected).abs() <= PIXELS * (expected.abs() + expected.abs().mean(1, keepdim=True))).all()


def test_a_short_training_has_the_same_losses(tmp_path: Path) -> None:
    for package in ("lightning_fabric", "tensorboard"):
        pytest.importorskip(package, reason="training needs the packages of mcdenoise[train]")
    torch.testing.assert_close(losses(tmp_path), DIGESTS[f"{COMMANDS}: losses"], rtol=LOSSES, atol=0)
