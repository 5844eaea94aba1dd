"""The example that renders with the denoiser in the loop, in its smallest form."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("mitsuba", reason="Mitsuba is not installed")

PATH = Path(__file__).resolve().parents[1] / "examples" / "inverse_rendering.py"


def test_descent_with_and_without_the_denoiser(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    example = SimpleNamespace(**runpy.run_path(str(PATH)))
    found = example.compare("scalar_rgb", size=16, steps=12, seeds=1, samples=64)
    for errors in found.values():
        assert len(errors) == 1
        assert len(errors[0]) in (7, 13)
    # A dozen steps from 0.3 towards 0.7 and 0.9 already come closer with either loss, where there is little noise.
    for loss in example.LOSSES:
        assert found[loss, "denoised"][0][-1] < found[loss, "denoised"][0][0]
    example.plot(found, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 0
    assert capsys.readouterr().out.count("error") == 5
