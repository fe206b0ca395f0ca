"""Surfaces from a mesh file: triangles in metres, z up, each corner with its albedo."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import trimesh

MAX_BYTES, MAX_FACES = 500_000_000, 5_000_000
PLAIN_ALBEDO = 0.25  # of surfaces without a colour, the same as poles
LUMA = np.array([0.2126, 0.7152, 0.0722])  # weights of linear red, green and blue (Rec. 709)
Y_UP = (".glb", ".gltf")


def is_mesh_path(name: str) -> bool:
    """Whether the name of a scene is a file path, that is, has a suffix or a folder."""
    return bool(Path(name).suffix) or os.sep in name


def read_mesh(path: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read a mesh file in any format of `trimesh`: glTF, OBJ, OFF, PLY, STL and more.

    glTF is y-up by its standard, so (x, y, z) becomes (x, -z, y): glTF's -z, away from the
    viewer, then points ahead. Other formats are not turned: metres, z up.

    The albedo is the luma of linear colour. glTF's factors and vertex colours are linear;
    textures and the colours of other formats are read as sRGB and converted to linear. A
    texture is sampled at the corners of the triangles only. Transparency is ignored.

    Args:
        path: Path of the file; textures and materials are looked for in its folder.

    Returns:
        Corners (F, 3, 3) float64 [m], unit normals (F, 3) float64 and the albedo of each
        corner (F, 3) float64 in [0, 1]. Triangles without area are left out.

    Raises:
        ValueError: There is no such file, it is too large, or it holds no usable triangles.
    """
    import trimesh  # only mesh files need it

    file = Path(path)
    if not file.is_file():
        raise ValueError(f"scene {path!r} must be the path of a mesh file, and there is no such file")
    if file.stat().st_size > MAX_BYTES:
        raise ValueError(f"scene {path!r} has {file.stat().st_size} bytes; at most {MAX_BYTES} are read")
    if file.suffix[1:].lower() not in trimesh.available_formats():
        known = sorted(trimesh.available_formats())
        raise ValueError(f"scene {path!r} must be a mesh file of one of the formats {known}")
    try:
        parts = _load(path)
    except MemoryError:
        raise
    except Exception as error:  # whatever the readers of a dozen formats raise
        raise ValueError(f"scene {path!r} cannot be read: {type(error).__name__}: {error}") from error
    if parts is None or not parts:
        found = "none" if parts is not None else "more"
        raise ValueError(f"scene {path!r} must have 1 to {MAX_FACES} triangles, got {found}")
    linear = file.suffix.lower() in Y_UP
    corners = np.concatenate([np.asarray(part.vertices, np.float64)[part.faces] for part in parts])
    albedo = np.concatenate([_albedo(part, linear) for part in parts])
    return _usable(path, corners[:, :, [0, 2, 1]] * (1.0, -1.0, 1.0) if linear else corners, albedo)


def _load(path: str) -> "list[trimesh.Trimesh] | None":
    """Load the meshes of a file at their places; None if they have too many triangles."""
    import trimesh

    scene = trimesh.load_scene(path, process=False)
    # Count before copying: a small file may place one mesh a thousand times.
    names = [scene.graph[node][1] for node in scene.graph.nodes_geometry]
    if sum(len(getattr(scene.geometry[name], "faces", ())) for name in names) > MAX_FACES:
        return None
    return [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]


def _usable(path: str, corners: np.ndarray, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the triangles that have an area, with their normals."""
    if not (np.isfinite(corners).all() and np.abs(corners).max() <= 1e6):
        raise ValueError(f"scene {path!r} must have finite vertices within 1e6 m")
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    solid = area > 0.0
    if not solid.any():
        raise ValueError(f"scene {path!r} must have a triangle with an area")
    return corners[solid], normals[solid] / area[solid, None], albedo[solid]


def _albedo(part: "trimesh.Trimesh", linear: bool) -> np.ndarray:
    """Return the albedo of each corner of each face, (F, 3)."""
    shape, kind = (len(part.faces), 3), part.visual.kind
    if kind == "texture":
        return np.broadcast_to(_material_albedo(part, linear), shape)
    if kind == "face":
        return np.repeat(_luma(part.visual.face_colors, linear)[:, None], 3, axis=1)
    if kind == "vertex":
        return _luma(part.visual.vertex_colors, linear)[part.faces]
    return np.full(shape, PLAIN_ALBEDO)


def _material_albedo(part: "trimesh.Trimesh", linear: bool) -> np.ndarray:
    """Return the albedo of the material, its colour times its texture, (F, 3) or one value."""
    from trimesh.visual.color import uv_to_color
    from trimesh.visual.material import PBRMaterial

    material: Any = part.visual.material
    pbr = isinstance(material, PBRMaterial)
    texels = uv_to_color(part.visual.uv, material.baseColorTexture if pbr else material.image)
    factor = material.baseColorFactor if pbr else material.diffuse
    if texels is None:
        return np.array(PLAIN_ALBEDO) if factor is None else _luma(factor, linear)
    tint = 1.0 if factor is None or not pbr else _linear(factor, linear)
    return _weighted(_linear(texels, False) * tint)[part.faces]


def _luma(colours: Any, linear: bool) -> np.ndarray:
    return _weighted(_linear(colours, linear))


def _weighted(rgb: np.ndarray) -> np.ndarray:
    """Return the luma of red, green and blue (..., 3); not by BLAS, whose rounding depends on its threads."""
    return np.asarray((rgb * LUMA).sum(axis=-1))


def _linear(colours: Any, linear: bool) -> np.ndarray:
    """Convert colours, uint8 (..., 3 or 4), to linear RGB in [0, 1]; they are sRGB unless `linear`."""
    rgb = np.asarray(colours)[..., :3] / 255.0
    return rgb if linear else np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
