"""A page for each method of the zoo, made of the register, its docstring, its weights, and the tables of the docs."""

from __future__ import annotations

import csv
import importlib
import inspect
import re
from functools import cache
from pathlib import Path

import mcdenoise.models
from mcdenoise.check.cases import OPS
from mcdenoise.models import describe_weights
from mcdenoise.models._overview import ModelOverview, overview
from mcdenoise.models._registry import find_model

ROOT = Path(__file__).resolve().parents[2]
KINDS = {
    "kernel": "Predict kernels",
    "pixel": "Predict pixels",
    "grid": "Bilateral grids",
    "recurrent": "Recurrent networks",
    "filter": "Filters without weights",
    "peer": "Open Image Denoise",
    "other": "Others",
}
WEIGHTS = {
    "shipped": "in the package, trained for hours",
    "compared": "in the package, trained for minutes, for comparisons on equal terms",
    "its own": "those of another package",
    "to train": "none; to be trained",
    "none": "none",
}
# How the tables of measurements call some methods.
NAMES = {
    "OIDN": "oidn",
    "OIDN high, features denoised first": "oidn",
}
PAPER = "*The paper* is [doi:10.1007/s00371-023-02951-6](https://doi.org/10.1007/s00371-023-02951-6)."
MEASURED = ("results.md", "performance.md", "zoo.md", "layers.md")
# Tables of the run time of network and filters at 1280x720: page, heading, anchor, column and machine.
RUN_TIMES = (
    ("zoo.md", "Trained on equal terms", "trained-on-equal-terms", 5, "an AMD EPYC"),
    ("performance.md", "Run time side by side", "run-time-side-by-side", 1, "an Intel Xeon"),
)


def pages() -> dict[str, str]:
    """Pages by their place in the site."""
    entries = _overview()
    found = {f"methods/{entry.name}.md": page(entry) for entry in entries}
    return found | {"methods/index.md": index(entries)}


@cache
def _overview() -> list[ModelOverview]:
    return overview()


def navigation() -> list[dict[str, list[str]]]:
    """Pages by what makes the image."""
    found = {
        title: [f"methods/{each.name}.md" for each in _overview() if each.kind == kind] for kind, title in KINDS.items()
    }
    return [{title: places} for title, places in found.items() if places]


def index(entries: list[ModelOverview]) -> str:
    """All methods, by what makes their image."""
    parts = [
        "# Methods\n\nEvery method is a name that `--model` and `Denoiser` take, and one file in `mcdenoise/models/`, "
        "to be read beside its paper. Its cost is in multiply-adds of convolutions. [The zoo](../zoo.md) and "
        "[Results](../results.md) compare errors. `mcdenoise models --all` prints this list."
    ]
    for kind, title in KINDS.items():
        rows = [
            f"| [`{entry.name}`]({entry.name}.md) | {entry.description} | {paper(entry)} | {entry.weights} "
            f"| {cost(entry)} |"
            for entry in entries
            if entry.kind == kind
        ]
        if rows:
            head = "| method | description | paper | weights | kMAC a pixel |\n|---|---|---|---|--:|"
            parts.append("\n".join([f"## {title}\n", head, *rows]))
    return "\n\n".join(parts) + "\n"


def cost(entry: ModelOverview) -> str:
    """Thousands of multiply-adds a pixel."""
    return "-" if entry.kmacs_per_pixel is None else f"{entry.kmacs_per_pixel:.1f}"


def run_time(name: str) -> str:
    """Milliseconds of a method at 1280x720, from the tables of the docs, or a dash."""
    for source, title, anchor, column, machine in RUN_TIMES:
        for heading, _, rows in tables(ROOT / "docs" / source):
            for row in rows if heading == title else []:
                if method_of(row[0]) == name and row[column]:
                    return (
                        f"{row[column]} ms at 1280x720 for network and filters, float32, two cores of {machine} "
                        f"([how it was measured](../{source}#{anchor}))"
                    )
    return "-"


def page(entry: ModelOverview) -> str:
    """One method."""
    construct = find_model(entry.name).construct
    module = importlib.import_module(construct.__module__)
    file = construct.__module__.replace(".", "/") + ".py"
    facts = {
        "description": entry.description,
        "paper": paper(entry),
        "required buffers": code(entry.needs),
        "optional buffers": code(entry.uses),
        "weights": WEIGHTS[entry.weights],
        "parameters": f"{entry.parameters:,}" if entry.parameters else "-",
        "cost": f"{cost(entry)} thousand multiply-adds a pixel in convolutions" if entry.kmacs_per_pixel else "-",
        "run time": run_time(entry.name),
        "source": f"`{file}`",
    }
    parts = [f"# {entry.name}", close_up(entry.name), facts_table(facts)]
    if entry.reason:
        parts.append(f"Not available where this page was made: {entry.reason}.")
    parts.append(f"```sh\nmcdenoise denoise shot/ -o clean/ --model {entry.name}\n```")
    parts.append("## How it works\n\n" + as_markdown(inspect.getdoc(module) or ""))
    if "s00371" in entry.paper:
        parts.append(PAPER)
    parts.append(equations(construct.__module__))
    parts.append(
        f"::: {construct.__module__}.{construct.__qualname__}\n"
        "    options:\n      heading: Settings\n      toc_label: Settings"
    )
    parts.append(trained(entry))
    parts.append("## Measured\n\n" + measured(entry.name))
    return "\n\n".join(part for part in parts if part) + "\n"


def close_up(name: str) -> str:
    """The picture and the errors that ``docs/site/close_ups.py`` made; nothing for a method that it could not run."""
    found = errors()
    if name not in found:
        return ""
    smape, psnr = found[name]
    return (
        f"![Two crops: noisy, {name}, reference](../close_ups/{name}.webp){{ .pixels width=100% }}\n\n"
        f"The last frame of a demo of 16 frames: one sample a pixel on the left, `{name}` in the middle, the reference "
        f"of 128 samples on the right. Over the whole frame its SMAPE is {smape} and its PSNR {psnr} dB, where the "
        f"noisy frame has {found['noisy'][0]} and {found['noisy'][1]} dB. `python docs/site/close_ups.py demo` makes "
        "such pictures of the frames of `mcdenoise demo`."
    )


@cache
def errors() -> dict[str, tuple[str, str]]:
    """SMAPE and PSNR of the frame of the close-ups, by method."""
    with (ROOT / "docs" / "close_ups" / "errors.csv").open(encoding="utf-8", newline="") as file:
        return {row["method"]: (row["SMAPE"], row["PSNR"]) for row in csv.DictReader(file)}


def facts_table(facts: dict[str, str]) -> str:
    """Two columns without a head of their own."""
    head, *rows = (f"| {name} | {text} |" for name, text in facts.items())
    return "\n".join([head, "|---|---|", *rows])


def paper(entry: ModelOverview) -> str:
    """Authors and year, or the link of a DOI."""
    return re.sub(r"DOI (\S+)", r"[doi:\1](https://doi.org/\1)", entry.paper) or "-"


def code(names: list[str]) -> str:
    """Names of buffers as code."""
    return ", ".join(f"`{name}`" for name in names) or "-"


def equations(module: str) -> str:
    """Links to the pages of the operators that a method calls, where their formulas are."""
    source = "".join(sources(module))
    called = [op.name for op in OPS if re.search(rf"(?<!def )\b{op.name}\(", source)]
    links = ", ".join(f"[`{name}`](../operators/{name}.md)" for name in called)
    return f"The operators that its code calls have their equations on pages of their own: {links}." if called else ""


def sources(module: str) -> list[str]:
    """The source of a module, and of those whose classes it takes its methods and its layers from."""
    found: dict[str, str] = {}
    ahead = [module]
    while ahead:
        name = ahead.pop()
        found[name] = inspect.getsource(importlib.import_module(name))
        parts = re.findall(
            r"^from (mcdenoise\.(?:models|nn)\.[a-z]\w*) import .*\b[A-Z][a-z]", found[name], re.MULTILINE
        )
        ahead += [part for part in parts if part not in found]
    return list(found.values())


def trained(entry: ModelOverview) -> str:
    """The text about the training of weights, from their header."""
    if entry.weights not in ("shipped", "compared"):
        return ""
    folder = Path(mcdenoise.models.__file__).parent / "weights" / ("compared" if entry.weights == "compared" else "")
    header = describe_weights(folder / f"{entry.name}.safetensors")
    rows = [
        f"| {name} | {value} |"
        for name, value in sorted(header.items())
        if 0 < len(str(value)) < 400 and "\n" not in str(value)
    ]
    return "\n".join(["## Weights\n", "The header of the file says:\n", "| field | value |", "|---|---|", *rows])


def as_markdown(text: str) -> str:
    """A docstring's roles and double backticks as Markdown."""
    text = re.sub(r":(?:func|class|meth|data|mod|attr):`~?([^`]+)`", r"`\1`", text)
    return re.sub(r"``(.+?)``", r"`\1`", text)


def measured(name: str) -> str:
    """The rows of this method in the tables of the docs, each under the heading that it has there."""
    parts = []
    for source in MEASURED:
        for heading, head, rows in tables(ROOT / "docs" / source):
            own = [row for row in rows if method_of(row[0]) == name]
            if own and len(head) > 1:
                lines = [head, ["---"] + ["--:"] * (len(head) - 1), *own]
                table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
                parts.append(f"[{heading}](../{source}):\n\n{table}")
    return (
        "\n\n".join(parts)
        or f"It stands in no table; `mcdenoise benchmark SEQUENCE -o OUT --models {name}` measures it on your frames."
    )


def method_of(cell: str) -> str:
    """The method that the first cell of a row names, if it names one."""
    plain = cell.replace("*", "").replace("`", "").strip()
    return NAMES.get(plain, plain)


def tables(path: Path) -> list[tuple[str, list[str], list[list[str]]]]:
    """Heading, column names and rows of each table of a page."""
    found: list[tuple[str, list[str], list[list[str]]]] = []
    heading, inside = "", False
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            heading = line.lstrip("# ").strip()
        if not line.startswith("|"):
            inside = False
            continue
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not inside:
            found.append((heading, cells, []))
            inside = True
        elif set(line) - set("|-: "):
            found[-1][2].append(cells)
    return found
