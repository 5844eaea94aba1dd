"""Run the checks on wrong ops: ``python tests/mutants/run.py [WORD...]``.

Each edit of ``mutants.py`` whose name contains all the words is made in a copy of the package; then the tests of all
ops, ``mcdenoise gradcheck`` and ``mcdenoise stability`` run for the op that it damages, until one of them fails.
Edits whose text is not in the file exactly once are stale: mend the list. Exits with 1 if an edit survives or is stale.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mutants import MUTANTS, Mutant

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 600


def commands(target: str) -> dict[str, list[str]]:
    """The checks of an op, or of ``model:NAME``, by name."""
    python = [sys.executable, "-m"]
    if target.startswith("model:"):
        name = target.removeprefix("model:")
        return {"stability": [*python, "mcdenoise", "stability", "--models", name, "--dtypes", "float32"]}
    tests = ["pytest", "-q", "-x", "-p", "no:xdist", "-p", "no:cacheprovider", "tests/ops/test_ops.py"]
    # What is compiled is the same formula once more, and takes longest.
    return {
        "tests": [*python, *tests, "-k", f"{target} and not compiles and not gradcheck"],
        "gradcheck": [*python, "mcdenoise", "gradcheck", target],
        "stability": [*python, "mcdenoise", "stability", target, "--dtypes", "float32", "float16"],
    }


def outcome(mutant: Mutant, copy: Path) -> str:
    """``killed by NAME``, ``survived``, ``stale``, or ``broken`` where a command could not run."""
    path = copy / "mcdenoise" / mutant.file
    text = path.read_text() if path.exists() else ""
    if text.count(mutant.right) != 1:
        return "stale"
    path.write_text(text.replace(mutant.right, mutant.wrong))
    try:
        for name, command in commands(mutant.target).items():
            try:
                status = subprocess.run(command, cwd=copy, timeout=SECONDS, capture_output=True, check=False).returncode
            except subprocess.TimeoutExpired:
                return f"broken: {name} takes longer than {SECONDS} s"
            if status == 1:
                return f"killed by {name}"
            if status:
                return f"broken: {name} exits with {status}"
        return "survived"
    finally:
        path.write_text(text)


def main(words: list[str]) -> int:
    """Print the outcome of each edit; 1 if one of them is not noticed."""
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in ("mcdenoise", "tests"):
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        for mutant in MUTANTS:
            if not all(word in mutant.name for word in words):
                continue
            start = time.perf_counter()
            found = outcome(mutant, copy)
            missed += not found.startswith("killed")
            print(f"{found} in {time.perf_counter() - start:.0f} s: {' '.join(mutant.name.split())}", flush=True)
    print(f"{missed} not noticed")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
