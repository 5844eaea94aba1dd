"""Write the mean of the weights of several runs of one model, each of which began where an earlier one ended.

python training/average_weights.py FIRST.safetensors SECOND.safetensors ... -o WEIGHTS.safetensors

Wortsman et al. 2022, "Model soups: averaging weights of multiple fine-tuned models improves accuracy without increasing
inference time": a uniform soup. The header is that of the last file, with the checksums of all under `mean_of`.
"""

import argparse
import json
import sys
from pathlib import Path

import torch

from mcdenoise.data.files import atomic_path
from mcdenoise.errors import InputError
from mcdenoise.models import create_model, describe_weights, save_weights


def average(files: list[Path], out: Path) -> None:
    """Write the mean of the weights in ``files`` to ``out``."""
    if len(files) < 2:
        raise InputError(f"expected at least two files of weights, found {len(files)}")
    about = [describe_weights(file) for file in files]
    name, settings = about[-1]["architecture"], about[-1]["settings"]
    states = [create_model(name, weights=file, **settings).state_dict() for file in files]
    model = create_model(name, **settings)
    model.load_state_dict({key: torch.stack([state[key].float() for state in states]).mean(0) for key in states[0]})
    header = {key: value for key, value in about[-1].items() if key not in ("architecture", "settings", "sha256")}
    header["mean_of"] = json.dumps([one["sha256"] for one in about])
    with atomic_path(out) as temporary:
        temporary.write_bytes(save_weights(model, name, settings, header))


def main() -> None:
    """Parse and average."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("files", type=Path, nargs="+", metavar="WEIGHTS", help="safetensors of one model")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="WEIGHTS")
    options = parser.parse_args()
    average(options.files, options.out)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
