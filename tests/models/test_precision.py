"""The precision of convolutions if none is requested."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from reads import without_reads
from refusals import refused

from mcdenoise import Denoiser, Frame, denoise, ops
from mcdenoise.models import _precision
from mcdenoise.models._precision import ENVIRONMENT, _machine, _measured, fastest_precision

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the file for the ratio of this machine, of a user who never measured one; the processor has bfloat16."""
    monkeypatch.delenv(ENVIRONMENT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(_precision, "_has_bfloat16", lambda device: True)
    return tmp_path / "mcdenoise" / "precision.json"


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Ratios that the next measurements find; what is left has not been measured."""
    ratios: list[float] = []
    monkeypatch.setattr(_precision, "_measured", lambda device: ratios.pop(0))
    return ratios


@pytest.mark.parametrize(
    ("ratio", "expected"), [(2.0, "bfloat16"), (1.2, "bfloat16"), (1.19, "float32"), (0.3, "float32")]
)
def test_bfloat16_is_chosen_where_it_is_measured_to_be_faster(
    measured: list[float], ratio: float, expected: str
) -> None:
    measured.append(ratio)
    chosen = fastest_precision(CPU)
    assert chosen.precision == expected
    assert f"takes {1 / ratio:.2f} of the time" in chosen.reason


def test_a_processor_without_bfloat16_is_not_measured(monkeypatch: pytest.MonkeyPatch, measured: list[float]) -> None:
    monkeypatch.setattr(_precision, "_has_bfloat16", lambda device: False)
    assert fastest_precision(CPU) == ("float32", "the processor has no bfloat16")


def test_a_measurement_is_kept_for_the_machine_that_made_it(
    cache: Path, measured: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    measured += [2.0, 1.0, 3.0]
    for _ in range(3):
        assert fastest_precision(CPU).precision == "bfloat16"
    # Another processor, another version of torch.
    monkeypatch.setattr(_precision, "_machine", lambda device: "another")
    assert fastest_precision(CPU).precision == "float32"
    assert json.loads(cache.read_text()) == {_machine(CPU): 2.0, "another": 1.0}
    assert list(cache.parent.iterdir()) == [cache]
    assert measured == [3.0]


@pytest.mark.usefixtures("no_finalizers")
@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[2.0]", b'"text"', b"\xff", b"[" * 100_000, "own", '{"KEY": NaN}', '{"KEY": -1}', '{"KEY": "x"}'],
)
def test_a_damaged_cache_is_measured_again(cache: Path, measured: list[float], content: bytes | str) -> None:
    cache.parent.mkdir()
    whole = content if isinstance(content, bytes) else content.replace("KEY", _machine(CPU)).encode()
    cache.write_bytes(whole)
    measured.append(2.0)
    assert fastest_precision(CPU).precision == fastest_precision(CPU).precision == "bfloat16"
    assert json.loads(cache.read_text())[_machine(CPU)] == 2.0


def test_no_room_for_the_cache(tmp_path: Path, measured: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    measured += [2.0, 2.0]
    assert fastest_precision(CPU).precision == fastest_precision(CPU).precision == "bfloat16"
    assert not measured


def test_the_environment_variable_chooses_the_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    for precision in ("float32", "bfloat16"):
        monkeypatch.setenv(ENVIRONMENT, precision)
        assert fastest_precision(CPU).precision == precision
    monkeypatch.setenv(ENVIRONMENT, "int4")
    assert re.search(r"MCDENOISE_PRECISION: .*'int4'", refused(fastest_precision, CPU))


def test_measuring_draws_none_of_the_callers_random_numbers() -> None:
    before = torch.get_rng_state()
    assert 0.01 < _measured(CPU) < 100
    assert torch.equal(torch.get_rng_state(), before)


def test_the_measurement_is_of_one_thread_and_leaves_the_others_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    threads, conv2d, seen = torch.get_num_threads(), F.conv2d, set()

    def watched(*arguments: Any, **settings: Any) -> torch.Tensor:
        seen.add(torch.get_num_threads())
        return conv2d(*arguments, **settings)

    monkeypatch.setattr(F, "conv2d", watched)
    try:
        torch.set_num_threads(2)
        _measured(CPU)
        assert seen == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


def test_a_limit_of_instructions_is_another_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    unlimited = _machine(CPU)
    assert torch.__version__ in unlimited
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", "AVX2")
    assert _machine(CPU) != unlimited


def test_who_gets_it(measured: list[float]) -> None:
    measured.append(2.0)
    assert Denoiser("wild_small").precision == "bfloat16"
    # The effect on these methods has not been measured.
    for others in (
        Denoiser("wild_small", differentiable=True),
        Denoiser("joint_bilateral"),
        Denoiser(torch.nn.Conv2d(3, 3, 1)),
        Denoiser("wild_small", precision="float32"),
    ):
        assert others.precision == "float32"
    assert re.search(r"precision: .*'int4'", refused(Denoiser, "wild_small", precision="int4"))


def test_the_report_says_why_and_the_image_is_that_of_the_precision(measured: list[float]) -> None:
    measured.append(2.0)
    frame = Frame(color=torch.rand(1, 3, 24, 32))
    chosen, asked = Denoiser("wild_small"), Denoiser("wild_small", precision="bfloat16")
    image = chosen(frame)
    assert torch.equal(image, asked(frame))
    assert chosen.report.precision == "a convolution in bfloat16 takes 0.50 of the time in float32 here"
    assert asked.report.precision == "asked for"
    array = denoise(frame.color[0].numpy(), layout="CHW", model="wild_small")
    assert torch.equal(torch.from_numpy(array), image[0])


def test_without_reads_a_shot_begins_in_float32_whatever_came_before() -> None:
    denoiser, frame = Denoiser("wild_small", precision="bfloat16"), Frame(color=torch.rand(1, 3, 24, 32))
    with ops.use("torch"), without_reads():
        first = denoiser(frame)
        assert not torch.equal(denoiser(frame), first)
        denoiser.reset()
        assert torch.equal(denoiser(frame), first)


@pytest.mark.parametrize("name", ["wild", "wild_small"])
@pytest.mark.parametrize("noise", [0.003, 0.01, 0.03, 0.1, 0.3])
def test_no_frame_gets_worse_by_rounding(name: str, noise: float) -> None:
    """An even surface shows most; a checker is its albedo."""
    rows, columns = torch.meshgrid(torch.arange(96) / 96, torch.arange(128) / 128, indexing="ij")
    albedo = (0.2 + 0.6 * ((rows * 6).floor() + (columns * 8).floor()) % 2).expand(1, 3, -1, -1).contiguous()
    clean = albedo * (0.6 + 0.3 * columns + 0.2 * torch.sin(6 * rows))
    draws = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    normal = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand_as(clean)
    frame = Frame(clean * (1 + noise * draws).clamp_min(0), albedo=albedo, normal=normal.contiguous())
    errors = {}
    for precision in ("float32", "bfloat16"):
        denoiser = Denoiser(name, precision=precision)  # type: ignore[arg-type]
        errors[precision] = float(((denoiser(frame) - clean).abs() / clean).mean())
    assert errors["bfloat16"] <= 1.02 * errors["float32"]
    assert ("hardly any noise" in denoiser.report.precision) == (noise <= 0.1)
    assert denoiser.precision == "bfloat16"
