"""A model of one's own: by the place of its factory, with a state, and what is wrong with it in one line."""

import re
import sys
from pathlib import Path

import pytest
import torch
from refusals import refused
from torch import Tensor, nn
from toys import Mean

from mcdenoise import Denoiser, Frame, create_model
from mcdenoise.models import Output, State

SIZE = (24, 32)


def frame(size: tuple[int, int] = SIZE, **buffers: Tensor) -> Frame:
    return Frame(color=torch.rand(1, 3, *size), **buffers)


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(
        '''
"""A user's own."""
import torch
from torch import nn

number = 3


class Blur(nn.Module):
    def __init__(self, channels: int = 4):
        super().__init__()
        first, second = nn.Conv2d(6, channels, 3, padding=1), nn.Conv2d(channels, 3, 3, padding=1)
        self.layers = nn.Sequential(first, nn.ReLU(), second)

    def forward(self, color, albedo):
        return color + self.layers(torch.cat([color, albedo], 1))


def network(channels: int = 4):
    """Two convolutions."""
    return Blur(channels)


instance = Blur()


def denoise(color, albedo, strength=1):
    return color


def nothing():
    return 5


def fails():
    raise RuntimeError("no luck\\ntoday")
'''
    )
    return path


def test_a_factory_of_ones_own_is_a_model(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(mine.parent)
    for place in (str(mine), "mine"):
        denoiser = Denoiser(f"{place}:network", channels=8)
        assert sum(parameter.numel() for parameter in denoiser.model.parameters()) == 6 * 8 * 9 + 8 + 8 * 3 * 9 + 3
        assert denoiser(frame(albedo=torch.rand(1, 3, *SIZE))).shape == (1, 3, *SIZE)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("{folder}/mine.py:absent", r"expected a factory 'absent' in .*mine\.py, found .*network"),
        ("{folder}/mine.py:", "expected a factory"),
        ("{folder}/mine.py:number", "expected a factory, .* a model, found an object of type int; add a function"),
        ("{folder}/mine.py:instance", "expected a factory, .* a model, found an object of type Blur; add a function"),
        ("{folder}/mine.py:denoise", "expected a factory, .* found one that requires color, albedo"),
        ("{folder}/mine.py:nothing", "expected a model with `needs` .*found int"),
        ("{folder}/mine.py:fails", "RuntimeError: no luck today"),
        ("{folder}/absent.py:network", "no such file"),
        ("{folder}/absent.py", "no such file"),
        ("{folder}/several.py", r"several\.py.* :smooth or :Sharp$"),
        ("{folder}/misspelt.py", r"misspelt\.py.* :factory$"),
        ("{folder}/misspelt.py:smooth", "cannot be imported: SyntaxError"),
        ("{folder}/broken.py:network", r"broken\.py.*ModuleNotFoundError"),
        ("package.of.nobody:network", r"package\.of\.nobody.*ModuleNotFoundError"),
        ("..:network", "cannot be imported"),
        (":", "cannot be imported"),
    ],
)
def test_a_factory_that_is_none_is_refused_in_one_line(mine: Path, name: str, message: str) -> None:
    several = "raise SystemExit\n\ndef smooth(): ...\n\nclass Sharp: ...\n\ndef _hidden(): ..."
    for file, text in (("several", several), ("misspelt", "def smooth(:"), ("broken", "import nothing_of_this_name")):
        (mine.parent / f"{file}.py").write_text(text)
    assert re.search(message, refused(lambda: create_model(name.format(folder=mine.parent))))


def test_a_file_may_import_modules_of_its_folder(tmp_path: Path) -> None:
    """This holds also if another folder has a module of the same name, and whatever the working folder is."""
    for folder, factor in (("a", 2), ("b", 3)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "neighbour_of_mine.py").write_text(f"FACTOR = {factor}\n")
        (tmp_path / folder / "mine.py").write_text(
            "from neighbour_of_mine import FACTOR\n\ndef network():\n    return lambda color: FACTOR * color\n"
        )
    path = sys.path.copy()
    first, second = (Denoiser(f"{tmp_path / folder}/mine.py:network") for folder in "ab")
    shown = frame()
    torch.testing.assert_close(first(shown), 2 * shown.color)
    torch.testing.assert_close(second(shown), 3 * shown.color)
    assert sys.path == path


def test_settings_are_those_of_the_factory(mine: Path) -> None:
    assert "it takes channels" in refused(lambda: create_model(f"{mine}:network", width=3))


def test_a_state_of_another_size_is_refused_in_one_line_where_the_model_minds() -> None:
    denoiser = Denoiser(Mean())
    denoiser(frame())
    assert re.search(r"\(1, 3, 24, 32\).*\(1, 3, 20, 32\)", refused(lambda: denoiser(frame((20, 32)))))
    denoiser.reset()
    assert denoiser(frame((20, 32))).shape == (1, 3, 20, 32)


def test_a_module_that_returns_an_output_alone_lacks_a_state() -> None:
    class Alone(Mean):
        def forward(self, frame: Frame, state: State = None) -> Output:  # type: ignore[override]
            return Output(frame.color)

    assert re.search(r"\(Output, state\).* Output", refused(lambda: Denoiser(Alone())(frame())))


def test_a_compiled_module_is_a_method_as_the_module_is() -> None:
    class Brighter(nn.Module):
        def forward(self, color: Tensor, albedo: Tensor) -> Tensor:
            return color + albedo

    given = frame(albedo=torch.rand(1, 3, *SIZE))
    compiled = torch.compile(Brighter(), backend="eager")
    torch.testing.assert_close(Denoiser(compiled)(given), Denoiser(Brighter())(given))


def test_an_argument_that_is_no_buffer_is_named() -> None:
    message = refused(lambda: Denoiser(lambda color, x: color)(frame()))
    assert message.startswith("buffer 'x'")
    assert "a model that does without" not in message
    assert Denoiser(lambda color, x: color)(frame(extra={"x": torch.ones(1, 1, *SIZE)})).shape == (1, 3, *SIZE)


@pytest.mark.parametrize("name", ["float16", "float64"])
def test_weights_of_another_precision_than_the_frame_are_named(name: str) -> None:
    class Convolution(nn.Conv2d):
        def forward(self, color: Tensor) -> Tensor:
            return super().forward(color)

    network = Convolution(3, 3, 1).to(getattr(torch, name))
    assert f"{name} weights" in refused(lambda: Denoiser(network)(frame()))
    assert Denoiser(network.float())(frame()).dtype == torch.float32
