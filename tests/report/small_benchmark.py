"""A finished benchmark of two scenes: real errors of made-up pictures, and every way to have no figures."""

from pathlib import Path

import numpy as np
import torch

from mcdenoise.data.exr import write_exr
from mcdenoise.evaluate import METRICS
from mcdenoise.results import Cell, Cost, Fit, Machine, Method, Results, Scene, Spread

WIDTH, HEIGHT, FRAMES = 96, 64, [3, 4, 5]
# A name that would break out of an element, an attribute, a script, a formula and a style sheet.
HOSTILE = "</script><script>window.broken = 1</script> \"'& $x_1$"


def picture(seed: int, noise: float, frame: int) -> np.ndarray:
    """A bright disc before stripes that move with the frame, and noise of mean 1 on it."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    clean = 0.3 + 0.2 * np.sin((x + 2 * frame) / 5)[..., None] * np.array([1.0, 0.5, 0.2])
    clean = clean + 3.0 * ((x - 60) ** 2 + (y - 30) ** 2 < 150)[..., None]
    random = np.random.default_rng([seed, frame]).gamma(4, 1 / 4, clean.shape)
    return (clean * (1 + noise * (random - 1))).astype(np.float32)


def write_benchmark(root: Path) -> None:
    """Write a benchmark with a missing method, one that failed on the second scene, and one with a hostile name."""
    methods = [
        Method("noisy", "baseline", "noisy", "noisy"),
        Method("ours", "trainable", "ours", "wild", parameters=1234),
        Method(HOSTILE, "fixed", "hostile", "oidn"),
        Method("fails", "fixed", "fails", "other"),
        Method("absent", "fixed", "absent", "absent", missing="the package <absent> is not installed"),
    ]
    noises = {"noisy": 1.0, "ours": 0.1, HOSTILE: 0.3, "fails": 0.2}
    scenes, cells = [], []
    for index, name in enumerate(("first", "second")):
        scenes.append(Scene(name, WIDTH, HEIGHT, [2, *FRAMES], FRAMES, FRAMES, 0.0123 if index == 0 else None))
        for place, method in enumerate(methods[:4]):
            if (name, method.name) == ("second", "fails"):
                cells.append(Cell(name, method.name, failure="RuntimeError: out of <memory>"))
                continue
            values: dict[str, list[float]] = {"SMAPE": [], "PSNR": []}
            for frame in FRAMES:
                image, reference = picture(place + 1, noises[method.name], frame), picture(0, 0.0, frame)
                save(root, name, method.folder, frame, image)
                save(root, name, "reference", frame, reference)
                pair = [torch.from_numpy(x).permute(2, 0, 1)[None] for x in (image, reference)]
                for metric, own in values.items():
                    own.append(float(METRICS[metric].function(*pair)))
            stages = {"read": Spread(2, 1, 3, 5), "write": Spread(1, 1, 1, 5)}
            if place:
                stages["network"] = Spread(10.0 * place, 9.0 * place, 12.0 * place, 5)
            cells.append(
                Cell(
                    name,
                    method.name,
                    {metric: float(np.mean(own)) for metric, own in values.items()},
                    {metric: Spread.of(own) for metric, own in values.items()},
                    Spread(3 + 10.0 * place, 3, 40, 5),
                    stages,
                    computing=Spread(10.0 * place, 9.0 * place, 12.0 * place, 5),
                    plan=[{"stage": "reproject", "skipped": 0.75, "reason": "still"}] if method.name == "ours" else [],
                )
            )
    costs = [Cost("ours", 100 * n, 100, Spread(n, 0.9 * n, 1.1 * n, 3)) for n in (1, 2, 4)]
    costs.append(Cost("ours", 4000, 2000, failure="too little <memory>"))
    machine = Machine("a <processor>", 2, 7.8, "cpu", 2, "Linux", {"torch": "2.13.0"})
    fits = [Fit("ours", 0.0, 100.0, 0.02)]
    command = "mcdenoise benchmark first second -o OUT"
    Results(command, "2026-10-21T12:00:00+00:00", machine, 3, scenes, methods, cells, costs, fits).write(root)


def save(root: Path, scene: str, method: str, frame: int, image: np.ndarray) -> None:
    path = root / "images" / scene / method / f"{frame}.exr"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, image, ["R", "G", "B"])
