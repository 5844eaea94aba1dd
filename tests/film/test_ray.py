"""A film on a Ray cluster, of which a node is lost."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from shots import pixels, same, write_manifest, write_shot

from mcdenoise.engines import LocalEngine, RayEngine
from mcdenoise.errors import InputError
from mcdenoise.film import read_film, run_film

ray = pytest.importorskip("ray", reason="films on a cluster need Ray: pip install 'mcdenoise[ray]'")
# The warnings are Ray's own; none is of this package.
pytestmark = [pytest.mark.filterwarnings("default"), pytest.mark.timeout(900)]
FRAMES = 8


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Three nodes of one slot, the first of which is the head and does nothing."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [made.add_node(num_cpus=1) for _ in range(3)]
    yield made, nodes
    ray.shutdown()
    made.shutdown()


def test_a_lost_node_loses_nothing(cluster: Any, tmp_path: Path) -> None:
    made, nodes = cluster
    shots = {f"s{i}": write_shot(tmp_path / f"in{i}", FRAMES, seed=i) for i in range(4)}
    manifest = write_manifest(tmp_path / "film.toml", shots, model="accumulated", threads=1)
    assert all(each.complete for each in run_film(read_film(manifest), tmp_path / "quiet", LocalEngine(1)))
    out = tmp_path / "out"
    lost = threading.Event()

    def lose() -> None:
        # While every node has something to do.
        while not list(out.glob("s*/*.exr")):
            time.sleep(0.02)
        made.remove_node(nodes[0], allow_graceful=False)
        lost.set()

    killer = threading.Thread(target=lose, daemon=True)
    killer.start()
    results = run_film(read_film(manifest), out, RayEngine(made.address))
    assert lost.wait(60)
    assert all(each.complete for each in results), [each.failures() for each in results]
    for name in shots:
        assert len(pixels(out / name)) == FRAMES
        assert same(out / name, tmp_path / "quiet" / name)


def test_no_cluster_is_told_in_one_line() -> None:
    with pytest.raises(InputError, match=r"auto.*cluster"):
        RayEngine("auto")
