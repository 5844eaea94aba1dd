"""Write the weights of a training run that has not ended, as it would if it ended at its last checkpoint.

python training/weights_of_checkpoint.py RUN -o WEIGHTS.safetensors
"""

import argparse
import json
from pathlib import Path

import torch

from mcdenoise.data.files import atomic_path
from mcdenoise.models import create_model, save_weights
from mcdenoise.train import TrainConfig
from mcdenoise.train.run_folder import about_weights


def main() -> None:
    """Parse and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of the run")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="WEIGHTS")
    options = parser.parse_args()
    config = json.loads((options.run / "config.json").read_text())
    data = json.loads((options.run / "data.json").read_text())
    checkpoint = torch.load(options.run / "checkpoint.pt", weights_only=True, map_location="cpu")
    network, *_, last = checkpoint["parts"]
    averages = {key.removeprefix("module."): value for key, value in last.items() if key.startswith("module.")}
    settings = TrainConfig(**config).model_settings
    model = create_model(config["model"], **settings)
    model.load_state_dict(averages if config["ema"] else network)
    about = about_weights(config, data, checkpoint["step"], checkpoint["provenance"])
    with atomic_path(options.out) as temporary:
        temporary.write_bytes(save_weights(model, config["model"], settings, about))


if __name__ == "__main__":
    main()
