"""Rendering on a Ray cluster of two nodes, one of which is lost: as on one machine."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import succeeds

from mcdenoise.data.exr import read_exr

ray = pytest.importorskip("ray", reason="clusters need Ray: pip install 'mcdenoise[ray]'")
pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
# Ray's own warnings; none is of this package.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default"), pytest.mark.timeout(1200)]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two nodes of one slot; the head runs no tasks."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [made.add_node(num_cpus=1) for _ in range(2)]
    yield made, nodes
    ray.shutdown()
    made.shutdown()


def lose(cluster: Any, out: Path, pattern: str) -> threading.Thread:
    def wait() -> None:
        while not list(out.glob(pattern)):
            time.sleep(0.02)
        cluster[0].remove_node(cluster[1][0], allow_graceful=False)

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def same(one: Path, other: Path) -> bool:
    images = [{path.relative_to(each): read_exr(path)[0] for path in each.rglob("*.exr")} for each in (one, other)]
    equal = all(np.array_equal(image, images[1].get(path)) for path, image in images[0].items())
    return bool(images[0]) and images[0].keys() == images[1].keys() and equal


def test_generate(cluster: Any, tmp_path: Path) -> None:
    small = "--size 24x16 --variant scalar_rgb --frames 3 --reference-spp 64 --noise-seeds 1"
    command = f"generate --assets none --seeds 0-3 {small} -o"
    succeeds(f"{command} {tmp_path}/quiet")
    lost = lose(cluster, tmp_path / "out", "*/inputs/color0.exr")
    succeeds(f"{command} {tmp_path}/out --workers {cluster[0].address}")
    lost.join(60)
    assert not lost.is_alive()
    assert same(tmp_path / "quiet", tmp_path / "out")
