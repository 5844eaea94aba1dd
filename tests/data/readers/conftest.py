"""Files to read: those of real renderers, those with the names of others, and any that a test makes up."""

import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

Image = np.ndarray[Any, Any]


@pytest.fixture(scope="session")
def rendered() -> Path:
    """The folder of what real renderers wrote."""
    return Path(__file__).parents[1] / "renderers"


@pytest.fixture(scope="session")
def others(rendered: Path) -> Any:
    """The script that writes files with the channel names of renderers which did not run here."""
    spec = importlib.util.spec_from_file_location("others", rendered / "others.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def save() -> Callable[..., Path]:
    """Write an EXR of channels by name; of several parts where these are named."""

    def written(path: Path, channels: Mapping[str, Any], kind: str = "float", **attributes: Any) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.stack([np.asarray(image, np.float32) for image in channels.values()], -1)
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
        spec.channelnames = tuple(channels)
        for name, value in attributes.items():
            spec.attribute(name, value)
        output = oiio.ImageOutput.create(str(path))
        assert output.open(str(path), spec), output.geterror()
        assert output.write_image(pixels), output.geterror()
        assert output.close()
        return path

    return written
