"""Assets: archives that hold anything, and models as they come out of them."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from mcdenoise.scenes import assets
from mcdenoise.scenes.assets import Assets, Model, open_assets

CATALOGUE = """
id#1=Scopia#box
name#1=Box
category#1=Office
model#1=/scopia/box/box.obj
width#1=200
depth#1=100
height#1=50
movable#1=true
doorOrWindow#1=false
dropOnTopElevation#1=50
lightSourceX#1=100
lightSourceY#1=50
lightSourceZ#1=50
lightSourceDiameter#1=8
creator#1=Somebody
id#2=Scopia#gone
model#2=/scopia/gone.obj
width#2=1
depth#2=1
height#2=1
"""
# A box of 4 x 1 x 2, with a square side that has a material, and indices from the end.
BOX = """mtllib {mtl}
v 0 0 0
v 4 0 0
v 4 1 0
v 0 1 2
vt 0 0
usemtl red
f 1/1 2/1 3/1 4/1
f -4/1 -3/1 -2/1
"""
MTL = "newmtl red\nKd 1 0 0\nKs 0.5 0.5 0.5\nNs 100\nd 0.25\n"


def folder_with(tmp_path: Path, members: dict[str, str]) -> Path:
    furniture = tmp_path / "usr/share/sweethome3d/furniture"
    furniture.mkdir(parents=True)
    (tmp_path / "images").mkdir()
    with zipfile.ZipFile(furniture / "Scopia.sh3f", "w") as files:
        for name, text in members.items():
            files.writestr(name, text)
    return tmp_path


def opened(tmp_path: Path, **members: str) -> Model:
    content = {"PluginFurnitureCatalog.properties": CATALOGUE, "scopia/box/box.obj": BOX.format(mtl="box.mtl")}
    content |= {"scopia/box/box.mtl": MTL} | {f"scopia/box/{name}.obj": text for name, text in members.items()}
    (model,) = open_assets(folder_with(tmp_path, content), lambda line: None).models
    return model


def test_a_model_has_its_size_place_and_credit(tmp_path: Path) -> None:
    model = opened(tmp_path)
    assert model.size == (2.0, 0.5, 1.0)
    assert model.top == 0.5
    assert model.credit == "Somebody, CC-BY 3.0"
    assert model.lamps[0].center == (0.0, 1.0, 0.0)
    ((mesh, surface),) = model.read()
    # It fills the cube, a quadrilateral is two triangles, and equal corners are one.
    assert np.allclose(mesh.vertices.min(0), -1)
    assert np.allclose(mesh.vertices.max(0), 1)
    assert len(mesh.faces) == 3
    assert len(mesh.vertices) == 7
    assert np.allclose(surface.color, (1, 0, 0))
    assert surface.opacity == 0.25
    assert surface.exponent == 100


@pytest.mark.parametrize("text", ["f 1 2 9", "v a b c\nf 1 1 1", "v nan 0 0\nf 1 1 1", "f 1//7 1//7 1//7\nv 0 0 0", ""])
def test_damaged_models_are_refused_in_one_line(tmp_path: Path, text: str) -> None:
    refused(opened(tmp_path, box=text).read)


@pytest.mark.parametrize(("far", "kept"), [("-3.5", True), ("3.4e9", False)])
def test_places_in_textures_without_digits_are_left_out(tmp_path: Path, far: str, kept: bool) -> None:
    text = BOX.format(mtl="box.mtl").replace("vt 0 0", f"vt 0 {far}")
    ((mesh, _),) = opened(tmp_path, box=text).read()
    assert (mesh.uv is not None) == kept


def test_members_are_read_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = opened(tmp_path)
    monkeypatch.setattr(assets, "_LARGEST_MEMBER", 20)
    refused(model.read)


def test_names_in_archives_lead_nowhere(tmp_path: Path) -> None:
    secret = tmp_path / "secret.mtl"
    secret.write_text("newmtl red\nKd 0 1 0\n")
    model = opened(tmp_path / "inside", box=BOX.format(mtl=f"../../../../{secret.name}"))
    ((_, surface),) = model.read()
    # Neither the file nor a member: the gray of a model without materials.
    assert np.allclose(surface.color, 0.5)


def test_a_tenth_is_kept_apart(tmp_path: Path) -> None:
    skies = tuple(tmp_path / f"{number}.exr" for number in range(400))
    everything = Assets(skies=skies)
    seen, unseen = everything.part(False).skies, everything.part(True).skies
    assert set(seen) | set(unseen) == set(skies)
    assert not set(seen) & set(unseen)
    assert 20 < len(unseen) < 70


def test_without_clients_a_line_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    said: list[str] = []
    found = open_assets(tmp_path / "cache", said.append)
    assert found == Assets()
    assert len(said) == 2
    assert all("\n" not in line for line in said)
