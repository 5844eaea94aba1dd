"""The architecture: which room may import which, and what importing the package costs."""

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import mcdenoise.models

PACKAGE = Path(__file__).resolve().parents[1] / "mcdenoise"
MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}

# The table of rooms names what each room (a module or folder right below mcdenoise/) may import besides itself. The
# test fails for a room that is not in it: place it deliberately.
SIGNAL = {"buffers", "errors", "frame", "light", "motion", "noise", "ops", "reading", "sampling"}
LIBRARY = SIGNAL | {"metrics", "nn", "models", "data", "scenes", "denoiser", "sequence_report"}
REPORTS = {"benchmark", "check", "evaluate", "folder", "methods", "report"}
TOOLS = REPORTS | {"budget", "export", "film", "preview", "suite", "train"}
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    "heap": set(),
    "reading": {"errors"},
    # It knows what a signal ends, and what must be tidied up then.
    "interruption": set(),
    "threads": set(),
    "turns": set(),
    # Tasks run in other processes, whatever they do.
    "engines": {"errors", "interruption"},
    # Its files are written as all files are; it reads none of the data.
    "user_cache": {"data", "errors", "reading"},
    "own": {"errors"},
    "commit": set(),
    "ops": set(),
    "light": {"errors", "ops"},
    "buffers": {"errors", "light"},
    "arrays": {"buffers", "errors"},
    "frame": {"arrays", "buffers", "errors", "light", "ops"},
    "noise": {"frame", "ops"},
    "motion": {"frame"},
    "sampling": {"frame"},
    "metrics": SIGNAL,
    "nn": SIGNAL,
    "models": SIGNAL | {"nn", "own", "user_cache"},
    # Leaves: what is read and rendered knows the frame, and no method.
    "data": SIGNAL | {"interruption"},
    "scenes": SIGNAL | {"data", "engines", "interruption", "user_cache"},
    "denoiser": SIGNAL | {"models"},
    "methods": SIGNAL | {"models", "denoiser"},
    # These modules are for scripts of a renderer: nothing of the package imports them.
    "integrations": SIGNAL | {"models", "denoiser", "threads"},
    "sequence_report": {"models"},
    "folder": LIBRARY,
    "shot": LIBRARY | {"budget", "methods", "preview"},
    "check": LIBRARY | {"methods", "own"},
    "evaluate": LIBRARY | {"folder"},
    "results": SIGNAL | {"data", "models"},
    "report": LIBRARY | {"evaluate", "results"},
    "benchmark": LIBRARY | {"check", "commit", "engines", "evaluate", "interruption", "methods", "results"},
    **dict.fromkeys(TOOLS - REPORTS - {"film"}, LIBRARY | REPORTS | {"commit", "results", "user_cache"}),
    "film": LIBRARY
    | {"commit", "engines", "folder", "heap", "interruption", "methods", "preview", "report", "results", "shot"},
    "cli": LIBRARY | TOOLS | {"engines", "heap", "interruption", "results", "shot", "threads"},
    "__main__": {"cli"},
    # The package itself, `from mcdenoise import Frame`: for users, and never imported from within.
    "": LIBRARY,
}
OPS_KNOW = {"torch", "kornia"}
# Fast backends are imported when one is chosen; `_backend` tests whether that is possible.
FAST_OPS_KNOW = OPS_KNOW | {"numba", "numpy"}
FAST_FORMS = ("mcdenoise.ops._numba",)
# Rooms in which a file still imports one that imports it.
CIRCULAR: set[str] = set()
# `from mcdenoise import Denoiser` leaves these alone: optional, slow to load, or of use to the command line only.
LAZY = {"OpenImageIO", "PIL", "av", "colour", "jinja2", "matplotlib", "numba", "triton", "tyro"}
LAZY |= {"drjit", "mitsuba", "pyoidn", "ray", "flip_evaluator", "lightning", "lightning_fabric", "tensorboard"}
SECONDS = 0.5


def room_of(module: str) -> str:
    return module.partition(".")[2].partition(".")[0]


def imported(module: str, source: str) -> Iterator[str]:
    """Absolute names of what a module imports, anywhere in it, also for type checking only."""
    is_package = MODULES[module].name == "__init__.py"
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = module.split(".")
                above = parents[: len(parents) - node.level + is_package]
                base = ".".join([*above, base] if base else above)
            # `from mcdenoise import ops` imports a room, `from mcdenoise import Frame` the package itself.
            for alias in node.names:
                name = f"{base}.{alias.name}"
                yield name if name in MODULES else base


def arrows(module: str, source: str) -> Iterator[str]:
    room = room_of(module)
    for name in imported(module, source):
        outermost = name.partition(".")[0]
        if outermost != "mcdenoise":
            known = FAST_OPS_KNOW if module.startswith(FAST_FORMS) else OPS_KNOW
            if room == "ops" and outermost not in known | sys.stdlib_module_names:
                yield f"{module} imports {name}: ops know torch, kornia and the standard library only"
        elif room_of(name) not in ALLOWED[room] | {room}:
            yield f"{module} imports {name}: not allowed by the table in {Path(__file__).name}"


def files_of(room: str) -> dict[str, set[str]]:
    """Return, for each file of a room, the files of it that it imports, whatever they hold."""
    files = {module for module in MODULES if room_of(module) == room}
    return {file: set(imported(file, MODULES[file].read_text())) & files - {file} for file in files}


def circles(graph: dict[str, set[str]]) -> list[str]:
    # A package holds the files below it: what they import of it is what it has imported of others before.
    inside = {file: {other for other in others if not file.startswith(f"{other}.")} for file, others in graph.items()}
    try:
        graphlib.TopologicalSorter(inside).prepare()
    except graphlib.CycleError as error:
        return [str(name) for name in error.args[1]]
    return []


def is_page(module: str) -> bool:
    *folders, name = module.split(".")
    return folders in (["mcdenoise", "ops"], ["mcdenoise", "ops", "_steps"]) and not name.startswith("_")


def python(code: str) -> str:
    """Return what a fresh interpreter prints, stderr included, with warnings as errors."""
    command = [sys.executable, "-W", "error", "-c", code]
    result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert result.returncode == 0, result.stdout
    return result.stdout


def test_every_room_has_a_place_in_the_table() -> None:
    assert {room_of(module) for module in MODULES} <= set(ALLOWED)


def test_the_table_has_no_cycle() -> None:
    graphlib.TopologicalSorter(ALLOWED).prepare()


@pytest.mark.parametrize("room", sorted(set(map(room_of, MODULES)) - {""} - CIRCULAR))
def test_no_circle_inside_a_room(room: str) -> None:
    assert not circles(files_of(room))


@pytest.mark.parametrize("module", [module for module in MODULES if module.startswith(FAST_FORMS)])
def test_a_fast_backend_has_the_name_of_its_op_and_imports_none(module: str) -> None:
    source = MODULES[module].read_text()
    assert not [name for name in imported(module, source) if is_page(name) or name == "mcdenoise.ops"]
    name = module.rpartition(".")[2]
    pages = {page.rpartition(".")[2] for page in MODULES if is_page(page)}
    assert name.startswith("_") or name in pages


def test_no_import_goes_up() -> None:
    assert not [line for module, path in MODULES.items() for line in arrows(module, path.read_text())]


def test_the_drawing_of_the_rooms_is_true() -> None:
    """A room imports only rooms of lines below its own, and rooms to its left."""
    page = (PACKAGE.parent / "docs" / "how-it-works.md").read_text(encoding="utf-8")
    drawn = [line.split()[1:] for line in page.partition("```text\n")[2].partition("```")[0].splitlines()]
    order = [room for line in reversed(drawn) for room in line]
    assert sorted(order) == sorted({room_of(module) for module in MODULES} - {"", "__main__"})
    for module, path in MODULES.items():
        room = room_of(module)
        others = {room_of(name) for name in imported(module, path.read_text()) if name.startswith("mcdenoise.")}
        if room in order:
            assert not [other for other in others - {room} if order.index(other) > order.index(room)], module


def test_importing_is_silent_and_loads_nothing_optional() -> None:
    code = f"import sys\nfrom mcdenoise import *\nprint(*sorted({LAZY!r} & set(sys.modules)))"
    assert python(code).strip() == ""


def test_the_command_line_loads_the_chosen_command_alone() -> None:
    code = (
        "import sys\nfrom mcdenoise.cli import COMMANDS, load_command\nload_command('models')\n"
        "print(*(name for name in COMMANDS if f'mcdenoise.cli.{name}' in sys.modules))\n"
        f"print(*sorted({LAZY - {'tyro'}!r} & set(sys.modules)))"
    )
    assert python(code).split("\n") == ["models", "", ""]


def test_until_the_command_line_obeys_signals_it_loads_next_to_nothing() -> None:
    code = "import sys\nbefore = set(sys.modules)\nimport mcdenoise.cli\nprint(*sorted(set(sys.modules) - before))"
    heavy = {"importlib.metadata", "email", "json", "numpy", "subprocess", "torch", "tyro"}
    assert not heavy & set(python(code).split())


def test_importing_is_quick() -> None:
    # Processor time, because others may use the machine; torch and kornia are not ours to shorten.
    code = (
        "import kornia, torch, time\nstart = time.process_time()\n"
        "from mcdenoise import *\nprint(time.process_time() - start)"
    )
    assert float(python(code)) < SECONDS


def test_the_zoo_has_few_public_names() -> None:
    assert len(mcdenoise.models.__all__) <= 25
