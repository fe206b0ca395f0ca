import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from envs.scene import make_scene
from envs.scene import mesh_file as meshfile
from envs.scene.mesh_file import PLAIN_ALBEDO, read_mesh

GREY = 188  # of 255 in sRGB: 0.5 in linear light
HALF_GREY = Image.fromarray(np.repeat(np.uint8([[0, 0, GREY, GREY]] * 4)[..., None], 3, axis=2))
TRIANGLE = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 2, 0)], [(0, 1, 2)], process=False)


def saved(folder, mesh, name):
    path = folder / name
    mesh.export(path)
    return str(path)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb", "gltf"])
def test_every_format_gives_the_same_surfaces_with_normals_outside(tmp_path, suffix):
    mesh = trimesh.creation.icosphere(2)
    mesh.apply_translation((1.0, 2.0, 5.0))
    y_up = suffix in ("glb", "gltf")
    if y_up:  # x right, y up, z backward
        mesh.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    if suffix == "gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
            (tmp_path / name.replace("model", "ball")).write_bytes(content)
        path = str(tmp_path / "ball.gltf")
    else:
        path = saved(tmp_path, mesh, f"ball.{suffix}")
    corners, normals, albedo = read_mesh(path)
    assert corners.shape == (320, 3, 3)
    assert np.linalg.norm(corners - (1.0, 2.0, 5.0), axis=2) == pytest.approx(1.0, abs=1e-5)
    assert ((corners.mean(axis=1) - (1.0, 2.0, 5.0)) * normals).sum(axis=1).min() > 0.9
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
    assert albedo == pytest.approx(PLAIN_ALBEDO)


def test_parts_stand_where_the_file_places_them_also_mirrored(tmp_path):
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(1)
    scene.add_geometry(ball, transform=trimesh.transformations.translation_matrix((5, 0, 0)))
    scene.add_geometry(ball, transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    corners, normals, _ = read_mesh(saved(tmp_path, scene, "two.glb"))
    middle = np.where(corners.mean(axis=1)[:, :1] > 2.5, 5.0, 0.0) * (1.0, 0.0, 0.0)
    assert ((corners.mean(axis=1) - middle) * normals).sum(axis=1).min() > 0.5


def painted(**fields):
    """The triangle in a colour for each vertex or face, or in a material."""
    mesh = TRIANGLE.copy()
    if "material" in fields:
        mesh.visual = trimesh.visual.TextureVisuals(uv=[(0, 0), (1, 0), (0, 1)], **fields)
    for name, colours in fields.items():
        setattr(mesh.visual, name, colours)
    return mesh


@pytest.mark.parametrize(
    ("mesh", "suffix", "albedo"),
    [
        (painted(vertex_colors=[(GREY,) * 3 + (255,), (255,) * 4, (0, 0, 0, 255)]), "ply", [0.5, 1.0, 0.0]),
        (painted(face_colors=[(255, 0, 0, 255)]), "ply", [0.2126] * 3),
        (painted(vertex_colors=[(128, 128, 128, 255)] * 3), "glb", [128 / 255] * 3),
        (painted(material=PBRMaterial(baseColorFactor=[0, 128, 0, 255])), "glb", [0.7152 * 128 / 255] * 3),
        (
            painted(material=PBRMaterial(baseColorTexture=HALF_GREY, baseColorFactor=[128, 128, 128, 255])),
            "glb",
            [0.0, 0.5 * 128 / 255, 0.0],
        ),
    ],
    ids=["vertices in sRGB", "faces in sRGB", "vertices of glTF", "factor of glTF", "texture in sRGB"],
)
def test_colours_are_made_linear_and_those_of_gltf_are_so_already(tmp_path, mesh, suffix, albedo):
    assert read_mesh(saved(tmp_path, mesh, f"t.{suffix}"))[2][0] == pytest.approx(albedo, abs=3e-3)


def test_triangles_without_area_are_left_out(tmp_path):
    mesh = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 2, 0)], [(0, 1, 2), (0, 1, 1)], process=False)
    assert len(read_mesh(saved(tmp_path, mesh, "t.ply"))[0]) == 1
    mesh.update_faces([False, True])
    with pytest.raises(ValueError, match="triangle with an area"):
        read_mesh(saved(tmp_path, mesh, "none.ply"))


def refusal(path):
    with pytest.raises(ValueError, match="scene ") as error:
        make_scene(str(path), np.random.default_rng(0))
    assert str(path) in str(error.value)
    return str(error.value)


def test_what_is_no_mesh_is_refused_with_one_message(tmp_path):
    assert "no such file" in refusal(tmp_path / "missing.glb")
    assert "no such file" in refusal(tmp_path)
    for name, text, rule in (
        ("notes.txt", "a tree", "formats"),
        ("empty.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "triangles"),
        ("nothing.obj", "", ""),
        ("far.obj", "v 0 0 0\nv 1e9 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
        ("nan.obj", "v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
    ):
        (tmp_path / name).write_text(text)
        assert rule in refusal(tmp_path / name)
    for name in ("broken.glb", "broken.stl", "broken.ply", "broken.gltf"):
        (tmp_path / name).write_bytes(b"\x00solid nothing" * 9)
        assert any(rule in refusal(tmp_path / name) for rule in ("cannot be read", "triangles, got none"))


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path, monkeypatch):
    path = saved(tmp_path, TRIANGLE, "t.stl")
    monkeypatch.setattr(meshfile, "MAX_BYTES", 100)
    monkeypatch.setattr(trimesh, "load_scene", lambda *_, **__: pytest.fail("it must not be read"))
    assert "at most 100" in refusal(path)


def test_a_small_file_that_places_many_triangles_is_refused_before_they_are_copied(tmp_path, monkeypatch):
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(2)
    for i in range(20):
        scene.add_geometry(
            ball, geom_name="ball", transform=trimesh.transformations.translation_matrix((i, 0, 0))
        )
    monkeypatch.setattr(meshfile, "MAX_FACES", 20 * 320 - 1)
    monkeypatch.setattr(trimesh.Scene, "dump", lambda *_, **__: pytest.fail("it must not be copied"))
    assert "triangles" in refusal(saved(tmp_path, scene, "many.glb"))


def test_a_gltf_that_names_a_remote_address_is_refused(tmp_path):
    (tmp_path / "deep").mkdir()
    header = {"asset": {"version": "2.0"}, "buffers": [{"uri": "http://localhost:1/x.bin", "byteLength": 36}]}
    (tmp_path / "deep" / "t.gltf").write_text(json.dumps(header))
    assert "cannot be read" in refusal(tmp_path / "deep" / "t.gltf")
