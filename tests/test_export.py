"""A model as one graph: compiled, exported for images of any size, and run by onnxruntime."""

import os
import shutil
import subprocess
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from commands import refuses, succeeds
from refusals import refused
from test_docs import blocks
from torch import Tensor, nn
from toys import Mean, Same, frame_of

from mcdenoise import Frame, create_model
from mcdenoise.export import Exported, Step, default_buffers, export_model, traced
from mcdenoise.models import Demodulated, Model, Needs, Output, State
from mcdenoise.models import Recurrent as Recurrence
from mcdenoise.models._weights import pretrained_models
from mcdenoise.models.wild import WildNetwork
from mcdenoise.nn.oidn import oidn_exposure

# Sums in another order, through some thirty layers: this is the suite's bound for whole models, see tests/golden.
RTOL, ATOL = 1e-4, 1e-5

MINE = '''
"""A user's own network, with its wrappers."""
import torch
from torch import nn

from mcdenoise.models import Accumulated, Demodulated


class Network(nn.Module):
    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(7, 4, 3, padding=1), nn.ReLU(), nn.Conv2d(4, 3, 3, padding=1))

    def forward(self, color, normal, length):
        return torch.relu(color + self.layers(torch.cat([color, normal, 1 / length], 1)))


def network():
    torch.manual_seed(0)
    return Demodulated(Accumulated(Network()))
'''


def frames(size: tuple[int, int], count: int = 3, batch: int = 1) -> list[dict[str, Tensor]]:
    """A shot of a wall that moves by a part of a pixel; its normals and depths have no noise, unlike its light."""
    depth, motion = torch.full((batch, 1, *size), 3.0), torch.full((batch, 2, *size), 0.6)
    depth[..., : size[0] // 4, :] = torch.inf
    still = {"normal": torch.nn.functional.normalize(torch.ones(batch, 3, *size), dim=1), "depth": depth}
    return [dict(frame_of(*size, batch, seed, motion=motion, **still).items()) for seed in range(count)]


class Moments(NamedTuple):
    mean: Tensor
    half: Tensor


class Recurrent(Same):
    """Means over time, at full and half the resolution; zeros are no history."""

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        half = torch.nn.functional.avg_pool2d(frame.color, 2, ceil_mode=True, count_include_pad=False)
        state = Moments(torch.zeros_like(frame.color), torch.zeros_like(half)) if state is None else state
        mean = 0.5 * state.mean + frame.color
        half = 0.5 * state.half + half
        return Output(mean + half.mean((2, 3), keepdim=True)), {"moments": Moments(mean, half)}["moments"]


def eager(model: Model, shot: list[dict[str, Tensor]]) -> list[Tensor]:
    state, images = None, []
    with torch.no_grad():
        for buffers in shot:
            output, state = model(Frame(**buffers), state)
            images.append(output.image)
    return images


def programmed(step: Step, program: torch.export.ExportedProgram, shot: list[dict[str, Tensor]]) -> list[Tensor]:
    # Guards say in which layouts of memory a graph was traced, and nothing of its result.
    run, state, images = program.module(check_guards=False), step.no_history(shot[0]), []
    for buffers in shot:
        image, state = run({name: buffers[name] for name in step.given}, state)
        images.append(image)
    return images


def with_onnxruntime(exported: Exported, step: Step, shot: list[dict[str, Tensor]]) -> list[Tensor]:
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    session = onnxruntime.InferenceSession(str(exported.path), providers=["CPUExecutionProvider"])
    state, images = {f"state.{name}": value.numpy() for name, value in step.no_history(shot[0]).items()}, []
    for buffers in shot:
        feeds = {name: buffer.numpy() for name, buffer in buffers.items()} | state
        image, *after = session.run(
            list(exported.outputs), {each.name: feeds[each.name] for each in session.get_inputs()}
        )
        state = {
            name.replace("next_state", "state"): value for name, value in zip(exported.outputs[1:], after, strict=True)
        }
        images.append(torch.from_numpy(image))
    return images


def assert_alike(found: list[Tensor], expected: list[Tensor]) -> None:
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=RTOL, atol=ATOL)


@pytest.fixture
def mine(tmp_path: Path) -> str:
    path = tmp_path / "mine.py"
    path.write_text(MINE)
    return f"{path}:network"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
def test_a_users_model_is_exported_with_its_wrappers(mine: str, tmp_path: Path) -> None:
    model = create_model(mine)
    exported = export_model(model, tmp_path / "mine.onnx", name="mine")
    assert exported.inputs == (
        *("color", "albedo", "normal", "depth", "motion"),
        *("state.color", "state.length", "state.surface.normal", "state.surface.depth"),
        *("state.surface.label", "state.limit", "state.light"),
    )
    assert exported.outputs[:2] == ("image", "next_state.color")
    step = Step(model, default_buffers(model))
    for size, batch in (((40, 64), 1), ((33, 47), 1), ((32, 32), 3)):
        shot = frames(size, batch=batch)
        assert_alike(with_onnxruntime(exported, step, shot), eager(model, shot))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
@pytest.mark.parametrize("name", ["wild_small"])
@pytest.mark.timeout(1800)
def test_models_of_the_zoo_are_exported(name: str, tmp_path: Path) -> None:
    model = create_model(name, pretrained=True)
    exported = export_model(model, tmp_path / "model.onnx")
    step, shot = Step(model, default_buffers(model)), frames((33, 47))
    assert_alike(with_onnxruntime(exported, step, shot), eager(model, shot))
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(exported.path), providers=["CPUExecutionProvider"])
    named = {size for each in session.get_inputs() for size in each.shape if isinstance(size, str)}
    assert named == {"batch", "height", "width"}
    import onnx
    from onnxruntime.transformers.float16 import DEFAULT_OP_BLOCK_LIST, convert_float_to_float16

    # On a CPU, onnxruntime has no ScatterND of float16.
    blocked = [*DEFAULT_OP_BLOCK_LIST, "ScatterND"]
    half = convert_float_to_float16(onnx.load(exported.path), keep_io_types=True, op_block_list=blocked)
    onnx.save(half, exported.path)
    for image, expected in zip(with_onnxruntime(exported, step, shot), eager(model, shot), strict=True):
        assert (image - expected).abs().mean() < 0.005 * expected.mean()


@pytest.fixture
def graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for package in ("onnxscript", "onnxruntime"):
        pytest.importorskip(package, reason="graphs in ONNX need the extra mcdenoise[export]")
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        export_model(Mean(), Path("model.onnx"))
    return tmp_path


def test_a_graph_is_run_as_the_page_for_engines_does(graph: Path) -> None:
    import onnx

    (block,) = (each for each in blocks("for-engines.md", "python") if "onnxruntime" in each)
    found: dict[str, Any] = {}
    exec(compile(block, "for-engines.md", "exec"), found)
    shot = [{"color": torch.from_numpy(np.random.default_rng(i).random((1, 3, 90, 160), np.float32))} for i in range(2)]
    assert_alike([torch.from_numpy(found["image"])], eager(Mean(), shot)[1:])
    model = onnx.load(graph / "model.onnx")
    assert [each.version for each in model.opset_import] == [20]
    assert {each.type.tensor_type.elem_type for each in (*model.graph.input, *model.graph.output)} == {
        onnx.TensorProto.FLOAT
    }


class InUnits(Same):
    """Radiance on Open Image Denoise's scale."""

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        return Output(frame.color * oidn_exposure(frame.color)), None


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
@pytest.mark.parametrize("make", [InUnits, lambda: WildNetwork("small").eval()], ids=["exposure", "wild"])
def test_a_graph_counts_and_clamps_as_python_does(make: Callable[[], Model], tmp_path: Path) -> None:
    pytest.importorskip("onnxscript", reason="graphs in ONNX need the extra mcdenoise[export]")
    torch.manual_seed(0)
    model = make()
    exported, step = export_model(model, tmp_path / "model.onnx"), Step(model, default_buffers(model))
    # A height of which a sixteenth is no whole number.
    (buffers, other, *_) = frames((33, 47))
    length = torch.full_like(buffers["color"][:, :1], 4.0)
    shot = [buffers | {"current": other["color"], "recent": other["color"], "length": length}]
    assert_alike(with_onnxruntime(exported, step, shot), eager(model, shot))


@pytest.mark.slow
def test_a_graph_is_run_in_cpp(graph: Path) -> None:
    """Where the headers of onnxruntime are, named by ONNXRUNTIME_INCLUDE; its library is that of Python."""
    import onnxruntime

    headers = Path(os.environ.get("ONNXRUNTIME_INCLUDE", "/usr/include/onnxruntime"))
    libraries = [*Path(onnxruntime.__file__).parent.glob("capi/libonnxruntime.so.*")]
    if not (headers / "onnxruntime_cxx_api.h").is_file() or not libraries or shutil.which("g++") is None:
        pytest.skip("no g++, or no headers of onnxruntime: name their folder, ONNXRUNTIME_INCLUDE=FOLDER")
    library = graph / "libonnxruntime.so.1"
    library.symlink_to(libraries[0])
    source = Path(__file__).parents[1] / "examples" / "engine" / "denoise.cpp"
    options = ("-std=c++17", "-isystem", headers, f"-Wl,-rpath,{graph}", "-Wall", "-Werror")
    subprocess.run(["g++", *options, source, library, "-o", "denoise"], check=True)
    shot = [{"color": each["color"]} for each in frames((11, 17))]
    given = b"".join(each["color"].numpy().tobytes() for each in shot)
    done = subprocess.run(["./denoise", "model.onnx", "17", "11"], input=given, capture_output=True, check=True)
    images = np.frombuffer(done.stdout, np.float32).reshape(3, 1, 3, 11, 17)
    assert_alike([torch.from_numpy(image.copy()) for image in images], eager(Mean(), shot))


def test_a_state_of_several_resolutions_and_images_of_any_size(tmp_path: Path) -> None:
    step = Step(Recurrent(), {"color"})
    assert step.state == ("mean", "half")
    program = traced(step)
    for size in ((40, 64), (33, 47), (8, 5)):
        shot = [{"color": buffers["color"]} for buffers in frames(size)]
        assert_alike(programmed(step, program, shot), eager(step.model, shot))
    # The file is an archive without pickled code, which torch loads by itself.
    export_model(step.model, tmp_path / "recurrent.pt2", buffers={"color"}, name="mine")
    extra = {"model": ""}
    loaded = torch.export.load(tmp_path / "recurrent.pt2", extra_files=extra)
    assert extra["model"] in ("mine", b"mine")
    assert_alike(programmed(step, loaded, shot), eager(step.model, shot))
    assert zipfile.is_zipfile(tmp_path / "recurrent.pt2")


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.parametrize("backend", ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_a_compiled_step_is_the_step(backend: str, mine: str) -> None:
    if backend == "inductor":
        pytest.importorskip("torch._inductor")
        from torch._inductor import cpp_builder

        try:
            cpp_builder.get_cpp_compiler()
        except Exception as error:
            pytest.skip(f"no C++ compiler: {error}")
    model = create_model(mine)
    torch._dynamo.reset()
    compiled = torch.compile(model, fullgraph=True, backend=backend)
    shot = frames((24, 32))
    assert_alike(eager(compiled, shot), eager(model, shot))


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
@pytest.mark.parametrize("name", ["", *(pytest.param(name, marks=pytest.mark.slow) for name in pretrained_models())])
@pytest.mark.timeout(1800)
def test_a_step_is_one_graph_of_fixed_shapes_that_can_be_replayed(name: str) -> None:
    """A CUDA graph requires that no value is read, no size depends on one, and a state goes in as it came out."""
    model = create_model(name, pretrained=True) if name else Demodulated(Recurrence(Moved()))
    step = Step(model, default_buffers(model))
    shot = frames((40, 56))
    given = [{name: buffers[name] for name in step.given} for buffers in shot]
    state = step.no_history(shot[0])
    program = torch.export.export(step, (given[0], state), strict=True)
    assert not program.range_constraints
    called = {str(node.target) for node in program.graph.nodes if node.op == "call_function"}
    reads = ("aten.item", "scalar_dense", "aten.nonzero", "masked_select", "sym_")
    assert not [each for each in called if any(read in each for read in reads)]
    sizes = [node.meta["val"].shape for node in program.graph.nodes if isinstance(node.meta.get("val"), Tensor)]
    assert all(isinstance(size, int) for shape in sizes for size in shape)
    run, images = program.module(check_guards=False), []
    for buffers in given:
        image, after = run(buffers, state)
        assert [(key, each.shape, each.dtype) for key, each in after.items()] == [
            (key, each.shape, each.dtype) for key, each in state.items()
        ]
        state = after
        images.append(image)
    assert_alike(images, eager(model, shot))


class Moved(nn.Module):
    """Adds half of the image before, from where it was."""

    needs = Needs(uses=frozenset({"previous"}))

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        return Output(frame.color + 0.5 * frame.extra["previous"]), None


class Impatient(Same):
    """Decides by the values of its input."""

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        return Output(frame.color if bool(frame.color.mean() > 1) else frame.color + 1), None


class Proud(Same):
    """Its first frame is not what zeros give."""

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        mean = frame.color if state is None else (frame.color + state) / 2
        return Output(mean), mean


class Fixed(Same):
    """Knows images of one size."""

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        return Output(frame.color + torch.ones(61, 1) if frame.size[0] == 61 else frame.color), None


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (Impatient(), "expected one that torch.export can trace"),
        (Proud(), "zeros must stand for no history"),
        (Fixed(), "expected one that torch.export can trace for images of any size"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_models_without_a_graph_are_refused_in_one_line_and_nothing_is_written(
    model: Model, message: str, tmp_path: Path
) -> None:
    assert message in refused(export_model, model, tmp_path / "model.pt2")
    assert not list(tmp_path.iterdir())


def test_the_command_writes_the_graph_and_says_its_names(
    mine: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "plain.py"
    own.write_text("def blur(color):\n    return color * 0.5\n\n\ndef factory():\n    return blur\n")
    printed = succeeds("export", f"{own}:factory", "-o", tmp_path / "half.pt2")
    assert "inputs: color\noutputs: image\n" in printed
    assert printed.endswith(f"wrote {tmp_path / 'half.pt2'}\n")
    program = torch.export.load(tmp_path / "half.pt2").module(check_guards=False)
    color = torch.rand(1, 3, 9, 7)
    assert torch.equal(program({"color": color}, {})[0], color * 0.5)
    for line, message in (
        (f"export {own}:absent -o x.onnx", "expected a factory 'absent'"),
        (f"export {own}:factory -o {tmp_path}/absent/x.pt2", "cannot be written"),
        (f"export {own}:factory -o x.pt2 --check {tmp_path}", "expected"),
    ):
        assert message in refuses(line)
