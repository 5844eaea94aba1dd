"""Code that a file, a folder or a package brings along: it runs only where the caller names it, and breaks nothing."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from commands import refuses, run
from refusals import refused
from safetensors.torch import save_file

from mcdenoise.models import create_model, describe_weights, load_weights, save_weights

# Calls that a header may ask for, with {touched} for a file that they would make.
HOSTILE = {
    "os:system": {"command": "touch {touched}"},
    "subprocess:run": {"args": "touch {touched}", "shell": True},
    "builtins:exec": {"source": "open('{touched}', 'w')"},
    "beside.py:make": {},
    "beside:make": {},
    " os:system": {"command": "touch {touched}"},
}
LINES = (
    "denoise {shot} -o out --weights {file}",
    "denoise {shot} -o out --model {file}",
    "evaluate {shot} --model {file}",
    "benchmark {shot} -o out --models {file}",
    "export {file} -o out.pt2",
    "film film.toml -o out",
)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder, with a module whose import leaves a file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "beside.py").write_text(
        f"open({str(tmp_path / 'touched')!r}, 'w')\n\n\ndef make():\n    return lambda color: color\n"
    )
    return tmp_path


def write(path: Path, architecture: str, settings: dict[str, Any]) -> Path:
    save_file({"a": torch.zeros(1)}, path, {"architecture": architecture, "settings": json.dumps(settings)})
    return path


@pytest.mark.parametrize("architecture", HOSTILE)
def test_a_weights_file_names_no_code(architecture: str, here: Path, small_sequence: Path) -> None:
    settings = {
        key: value.format(touched=here / "touched") if isinstance(value, str) else value
        for key, value in HOSTILE[architecture].items()
    }
    file = write(here / "hostile.safetensors", architecture, settings)
    assert "name the model yourself" in refused(load_weights, file)
    (here / "film.toml").write_text(f'[[shot]]\nname = "a"\ninput = "{small_sequence}"\nmodel = "{file}"\n')
    for line in LINES:
        status, _, said = run(line.format(shot=small_sequence, file=file))
        assert not (here / "touched").exists(), line
        assert status == 2, (line, said)
        assert "Traceback" not in said
    assert not (here / "out.safetensors").exists()


@pytest.mark.parametrize("model", ["os:system(command=touch touched)", "beside.py:make", "beside:make"])
@pytest.mark.parametrize("key", ["model", "start_from"])
def test_a_recipe_and_a_manifest_name_no_code(model: str, key: str, here: Path) -> None:
    (here / "recipe.toml").write_text(f'[train]\n{key} = "{model}"\nsteps = 1\n[[data]]\nseeds = "0"\n')
    (here / "film.toml").write_text(f'[[shot]]\nname = "a"\ninput = "shot"\nmodel = "{model}"\n')
    for line in ("train --recipe recipe.toml -o out", "film film.toml -o out"):
        refuses(line)
        assert not (here / "touched").exists()
        assert not (here / "out").exists()


@pytest.mark.parametrize("key", ["blender_python", "workers"])
def test_a_recipe_names_no_program_and_no_machine(key: str, here: Path) -> None:
    (here / "recipe.toml").write_text(f'[train]\nsteps = 1\n[[data]]\nseeds = "0"\n{key} = "/bin/true"\n')
    assert key in refuses("train --recipe recipe.toml -o out")


def test_weights_of_ones_own_model_are_loaded_with_its_factory(here: Path, small_sequence: Path) -> None:
    (here / "folder").mkdir()
    (here / "folder/own.py").write_text(
        "from mcdenoise.models import create_model\n\n\ndef make(width=4):\n"
        "    return create_model('cascaded', width=width)\n"
    )
    name = f"{here}/folder/own.py:make"
    file = here / "make.safetensors"
    file.write_bytes(save_weights(create_model(name), name, {}, {}))
    # Somebody else's folders are neither of use nor of interest.
    assert describe_weights(file)["architecture"] == "own.py:make"
    assert "name the model yourself" in refused(load_weights, file)
    saved = {key: value.half() for key, value in create_model(name, weights=file).state_dict().items()}
    assert saved.keys() == load_weights(file, name).state_dict().keys()
    assert run(f"denoise {small_sequence} -o denoised --model {name} --weights {file}")[0] == 0
    assert run(f"evaluate {small_sequence} --model {name}(weights={file})")[0] == 0


EXITS = {
    "at its import": "import sys\nsys.exit(0)",
    "in its factory": "import sys\n\n\ndef make():\n    sys.exit(0)",
    "in a step": "import sys\n\n\ndef make():\n    def own(color):\n        sys.exit(0)\n\n    return own",
    "with a word": "def make():\n    raise SystemExit('all is well')",
    "by no exception": "class End(BaseException): ...\n\n\ndef make():\n    raise End",
}


@pytest.mark.parametrize(
    ("exits", "line"),
    [
        ("at its import", "denoise {shot} -o out --model own.py:make"),
        ("in a step", "denoise {shot} -o out --model own.py:make"),
        ("in its factory", "evaluate {shot} --model own.py:make"),
        ("by no exception", "evaluate {shot} --model own.py:make"),
        ("in a step", "export own.py:make -o out.pt2 --buffers color"),
        ("with a word", "stability own.py:make"),
    ],
)
def test_a_model_that_exits_ends_no_command_with_success(
    line: str, exits: str, here: Path, small_sequence: Path
) -> None:
    (here / "own.py").write_text(EXITS[exits])
    status, _, said = run(line.format(shot=small_sequence))
    assert status in (1, 2), said
    assert "Traceback" not in said
    assert not list(here.glob("out*/*.exr"))
    if not line.startswith("stability"):
        assert (status, said.count("\n")) == (2, 1), said


@pytest.mark.parametrize(
    "name",
    ["builtins:exit", "os:abort", "sys:exit", "os:_exit", "subprocess:run(args=touch)", "torch:rand", "torch:nn"],
)
def test_a_factory_is_of_a_file_or_a_package_and_returns_a_model(name: str, here: Path, small_sequence: Path) -> None:
    refuses(f"denoise {small_sequence} -o out --model {name}")
    assert not (here / "out").exists()


MODULES = ["numpy", "torch", "mitsuba", "drjit", "typing", "socket", "pickle"]
MODULES += ["json", "random", "multiprocessing", "bpy"]


@pytest.mark.parametrize(
    "line",
    [
        "-m mcdenoise inspect {shot}",
        "-m mcdenoise film film.toml -o out --workers 2",
        "-m mcdenoise generate -o made --assets none --seeds 0 --frames 2 --size 32x32 --reference-spp 2 --workers 2",
    ],
    ids=["command", "workers", "spawned"],
)
def test_modules_of_the_working_folder_are_not_imported(line: str, here: Path, small_sequence: Path) -> None:
    if "generate" in line:
        pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    for name in MODULES:
        (here / f"{name}.py").write_text(f"open({str(here / 'touched')!r}, 'a').write({name!r})\nraise SystemExit(3)\n")
    (here / "film.toml").write_text(f'[[shot]]\nname = "a"\ninput = "{small_sequence}"\nmodel = "noisy"\n')
    (here / ".numba_config.yaml").write_text(f"cache_dir: {here}/hostile\n")
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, *line.format(shot=small_sequence).split()]
    done = subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, check=False)
    assert not (here / "touched").exists(), (here / "touched").read_text()
    assert done.returncode == 0, done.stderr
    assert not (here / "hostile").exists()


def test_native_code_beside_a_scene_is_not_loaded(here: Path) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    from mcdenoise.scenes.render.loading import Stage

    (here / "plugins").mkdir()
    for suffix in (".so", ".dylib", ".dll"):
        (here / f"plugins/diffuse{suffix}").write_text("no library")
    scene = '<scene version="3.0.0">{}<shape type="rectangle"><bsdf type="diffuse"/></shape></scene>'
    (here / "elsewhere").mkdir()
    (here / "elsewhere/scene.xml").write_text(scene.format(""))
    Stage(here / "elsewhere/scene.xml", "scalar_rgb")
    (here / "scene.xml").write_text(scene.format(""))
    (here / "elsewhere/other.xml").write_text(scene.format(f'<path value="{here}"/>'))
    for place in ("scene.xml", "elsewhere/other.xml"):
        assert "plug-ins" in refused(Stage, here / place, "scalar_rgb")
