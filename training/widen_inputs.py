"""Give weights of fewer input channels those that their model has by now, on which they do not depend yet.

    python training/widen_inputs.py OLD.safetensors -o NEW.safetensors

The images stay the same: the new channels are multiplied with zeros, from which training starts.
"""

import argparse
from pathlib import Path

import torch
from safetensors import safe_open

from mcdenoise.data.files import atomic_path
from mcdenoise.models import create_model, describe_weights, save_weights
from mcdenoise.models._weights import _named


def widened(path: Path) -> bytes:
    """The file of the wider model's weights."""
    about = describe_weights(path)
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key).float() for key in file.keys()}  # noqa: SIM118 - a handle is no dict
    model = create_model(about["architecture"], **about["settings"])
    for key, own in _named(model).items():
        tensor = tensors[key]
        if own.dim() == 4 and own.shape[1] > tensor.shape[1]:
            missing = tensor.new_zeros(len(tensor), own.shape[1] - tensor.shape[1], *tensor.shape[2:])
            tensor = torch.cat([tensor, missing], 1)
        with torch.no_grad():
            own.copy_(tensor)
    texts = {key: value for key, value in about.items() if key not in ("architecture", "settings", "sha256")}
    return save_weights(model, about["architecture"], about["settings"], texts)


def main() -> None:
    """Parse and convert."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("weights", type=Path, metavar="OLD")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="NEW")
    options = parser.parse_args()
    with atomic_path(options.out) as temporary:
        temporary.write_bytes(widened(options.weights))


if __name__ == "__main__":
    main()
