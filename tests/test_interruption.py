"""Commands that are told to end, at any moment: one line, the status of the signal, nothing left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import succeeds

WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}
# It takes no more than 2 s where the machine is free; others may use it.
SECONDS = 10.0
# A command that says when it obeys signals, a moment after the interpreter does.
OBEYING = """
from mcdenoise import cli

heed = cli.heed_signals

def begin(name):
    heed(name)
    print("begun", flush=True)

cli.heed_signals = begin
cli.main()
"""
# A further command, whose work is one statement.
OWN = """
import contextlib, hashlib, importlib, pathlib, sys, time, types
from mcdenoise import cli

def wait():
    print("begun", flush=True)
    {moment}

def endless():
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)

def swallowed():
    while True:
        with contextlib.suppress(BaseException):
            time.sleep(60)

class Destroyed:
    def __del__(self):
        time.sleep(0.2)

def destroyed():
    while True:
        Destroyed()

def tidied(how):
    try:
        time.sleep(60)
    finally:
        how()

def file(wait):
    from mcdenoise.data.files import atomic_path
    with atomic_path(pathlib.Path("made.txt")) as path:
        path.write_text("half")
        wait()

def folder(wait):
    from mcdenoise.data.files import new_folder
    with new_folder(pathlib.Path("made")) as path:
        (path / "one").write_text("half")
        wait()

cli.COMMANDS["wait"] = "Does one thing."
page = types.ModuleType("mcdenoise.cli.wait")
page.wait = wait
sys.modules[page.__name__] = page
cli.main()
"""
MOMENTS = {
    "sleep": "time.sleep(60)",
    "compiled code": "endless()",
    "an import": "importlib.import_module('slow_module')",
    "what swallows it": "swallowed()",
    "destructors": "destroyed()",
    "what tidies up in compiled code": "tidied(endless)",
}
WRITING = {"a file": "file(lambda: time.sleep(60))", "a folder, in compiled code": "folder(endless)"}


# These tests may themselves run in the background, or under nohup, and what is ignored is inherited.
HEEDING = """import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGTERM, signal.SIG_DFL)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
"""


def started(code: str, *arguments: object, folder: Path) -> subprocess.Popen[str]:
    """A process with a group of its own, as a shell starts it: not one in the background, which ignores Ctrl+C."""
    command = [sys.executable, "-c", f"{HEEDING}{code}", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, **pipes, text=True, start_new_session=True, cwd=folder)


def end(process: subprocess.Popen[str], number: signal.Signals, name: str, lines: int = -1) -> None:
    """Send a signal to a command and all its processes; one that has printed all its lines may have ended."""
    with process:
        os.killpg(process.pid, number)
        start = time.monotonic()
        try:
            printed, errors = process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    assert time.monotonic() - start < SECONDS
    if process.returncode == 0 and printed.count("\n") == lines:
        assert errors == ""
        return
    assert errors == f"mcdenoise {name}: {WORDS[number]}; finished files are kept\n"
    assert process.returncode == 128 + number


def interrupt(folder: Path, moment: str, number: signal.Signals = signal.SIGINT) -> None:
    (folder / "slow_module.py").write_text("import time\ntry:\n    time.sleep(60)\nexcept BaseException:\n    pass\n")
    process = started(OWN.replace("{moment}", moment), "wait", folder=folder)
    assert process.stdout.readline() == "begun\n"
    # Wait until it does what is meant: a file is only written once its reader is loaded.
    deadline = time.monotonic() + 60
    while moment in WRITING.values() and not list(folder.glob(".mcdenoise-*")):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(0.1)
    end(process, number, "wait")
    assert [path.name for path in folder.iterdir()] == ["slow_module.py"]


# The others take seconds each.
QUICK = ("compiled code", "destructors", "a file")


@pytest.mark.parametrize(
    "moment", [pytest.param(each, marks=[] if each in QUICK else [pytest.mark.slow]) for each in (*MOMENTS, *WRITING)]
)
def test_whatever_a_command_does_it_can_be_interrupted(moment: str, tmp_path: Path) -> None:
    interrupt(tmp_path, (MOMENTS | WRITING)[moment])


def test_other_signals_end_it_alike(tmp_path: Path) -> None:
    interrupt(tmp_path, MOMENTS["sleep"], signal.SIGTERM)


def test_signals_that_were_ignored_stay_ignored(tmp_path: Path) -> None:
    before = "import signal\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    process = started(before + OWN.replace("{moment}", "time.sleep(1)"), "wait", folder=tmp_path)
    process.stdout.readline()
    os.killpg(process.pid, signal.SIGHUP)
    assert process.communicate(timeout=60) == ("", "")
    assert process.returncode == 0


def test_within_another_program_signals_are_left_as_they_were() -> None:
    before = [signal.getsignal(number) for number in WORDS]
    succeeds("--version")
    assert [signal.getsignal(number) for number in WORDS] == before
    assert signal.set_wakeup_fd(-1) == -1


def test_a_few_moments_of_denoise(tmp_path: Path) -> None:
    """A shot of 160x90, large enough for compiled kernels, while modules are imported and then denoised."""
    torch = pytest.importorskip("torch")
    from mcdenoise import Frame
    from mcdenoise.data.readers.bmfr import write_bmfr_frame

    for number in range(60):
        images = [torch.rand(1, count, 90, 160) for count in (3, 3, 1)]
        write_bmfr_frame(tmp_path / "inputs", number, Frame(*images[:2], depth=1 + images[2]))
    out = tmp_path / "out"
    for number in (signal.SIGINT, signal.SIGTERM):
        process = started(OBEYING, "denoise", tmp_path / "inputs", "-o", out, "--model", "wild_small", folder=tmp_path)
        process.stdout.readline()
        if number == signal.SIGINT:
            time.sleep(0.5)
        else:
            # Not after a fixed time, in which a fast machine denoises all frames.
            deadline = time.monotonic() + 60
            while not list(out.glob("*.exr")):
                assert time.monotonic() < deadline
                time.sleep(0.02)
        end(process, number, "denoise")
        assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".mcdenoise-")]
