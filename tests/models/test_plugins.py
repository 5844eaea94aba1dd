"""Models that installed packages offer: a broken one is named where it is asked for, and hinders no other."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from refusals import refused

from mcdenoise import Denoiser, Frame, create_model, list_models
from mcdenoise.models import _registry
from mcdenoise.models._overview import overview, users_of
from mcdenoise.models._registry import troubles

# The source of a module that offers the factory `make`, and a part of the reason why it is no model.
BROKEN = {
    "raises": ("raise ArithmeticError('no luck')", "ArithmeticError: no luck"),
    "exits": ("import sys\nsys.exit(0)", "SystemExit"),
    "ends": ("class End(BaseException): ...\nraise End", "End"),
    "misspelt": ("def make(:", "SyntaxError"),
    "recurses": ("def make():\n    return make()", "RecursionError"),
    "asks_itself": (
        "import mcdenoise\ndef make():\n    return mcdenoise.create_model('asks_itself')",
        "RecursionError",
    ),
    "exits_later": ("import sys\ndef make():\n    sys.exit(0)", "SystemExit"),
    "unspeakable": (
        "class Odd(Exception):\n    def __str__(self):\n        raise ValueError\ndef make():\n    raise Odd",
        "Odd",
    ),
    "registers_a_taken_name": (
        "from mcdenoise.models import register_model\n@register_model('svgf')\ndef make():\n    return None",
        "registered twice",
    ),
    "lacks_it": ("", "make"),
    "returns_nothing": ("def make():\n    return None", "NoneType"),
    "needs_fail": (
        "class make:\n    @property\n    def needs(self):\n        raise SystemExit(0)\n    def __call__(self): ...",
        "SystemExit",
    ),
}


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    for name, (source, _) in BROKEN.items():
        (tmp_path / f"package_that_{name}.py").write_text(source)
        install(tmp_path, f"that_{name}", f"[mcdenoise.models]\n{name} = package_that_{name}:make\n")
    install(tmp_path, "taking", "[mcdenoise.models]\nsvgf = package_that_exits:make\n")
    install(tmp_path, "vague", "[mcdenoise.models]\nvague = neither a module: nor a factory!\n")
    damaged = install(tmp_path, "damaged", "")
    (damaged / "entry_points.txt").write_bytes(b"[mcdenoise.models]\nx = \xff\xfe:y\n")
    (install(tmp_path, "nameless", "[other]\na = b:c\n") / "METADATA").unlink()
    monkeypatch.syspath_prepend(str(tmp_path))
    _registry._offered.cache_clear()
    yield tmp_path
    for name in [*BROKEN, "vague"]:
        _registry.MODELS.pop(name, None)
    _registry._offered.cache_clear()


def install(site: Path, package: str, entry_points: str) -> Path:
    folder = site / f"{package}-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(entry_points)
    return folder


def test_a_broken_model_is_named_where_it_is_asked_for(site: Path) -> None:
    assert set(BROKEN) | {"vague"} <= set(list_models())
    for name, (_, reason) in {**BROKEN, "vague": ("", "")}.items():
        message = refused(create_model, name)
        assert f"'{name}'" in message
        assert reason in message
        (listed,) = overview(name)
        assert reason in listed.reason


def test_it_hinders_no_other(site: Path) -> None:
    frame = Frame(color=torch.rand(1, 3, 8, 8))
    assert torch.equal(Denoiser("noisy")(frame), frame.color)
    assert create_model("svgf").needs.buffers
    assert "kpcn" in users_of(["albedo"])["albedo"]
    assert "joint_bilateral" in refused(Denoiser(lambda color, albedo: color), frame)
    assert "did you mean" in refused(create_model, "svgff")


def test_an_offer_that_cannot_be_read_is_listed(site: Path) -> None:
    found = troubles()
    assert all("\n" not in line for line in found)
    (taken,) = (line for line in found if "'svgf'" in line)
    assert taken.startswith("taking")
    (damaged,) = (line for line in found if line not in taken)
    assert damaged.startswith("damaged")
