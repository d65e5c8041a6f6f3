"""Meshes that tests make themselves: closed solids, and a cup with a thin wall."""

from pathlib import Path

import numpy as np

from mstfilter.lab.simulation.surfaces import Triangles


def box_mesh(half):
    """A box about the origin: vertices (8, 3) and faces (12, 3) that point outwards."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def lathe_mesh(profile, sides=24):
    """A closed solid of revolution about z of a profile of (radius, z); it begins and ends on the axis."""
    angle = np.arange(sides) * 2 * np.pi / sides
    rings = [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(sides, z)]) for r, z in profile[1:-1]]
    vertices = np.concatenate([[(0, 0, profile[0][1])], *rings, [(0, 0, profile[-1][1])]])
    faces, n = [], len(rings)
    for k in range(sides):
        j = (k + 1) % sides
        faces.append((0, 1 + j, 1 + k))
        for i in range(n - 1):
            a, b = 1 + i * sides, 1 + (i + 1) * sides
            faces += [(a + k, a + j, b + j), (a + k, b + j, b + k)]
        a = 1 + (n - 1) * sides
        faces.append((len(vertices) - 1, a + k, a + j))
    return vertices, np.array(faces)


def cup_mesh(radius=0.04, height=0.09, wall=0.003, sides=24):
    """A cup with walls and floor of `wall` metres. Its volume is that of the cylinder less the inside."""
    inner = radius - wall
    return lathe_mesh([(0, 0), (radius, 0), (radius, height), (inner, height), (inner, wall), (0, wall)], sides)


def triangles(vertices, faces, **colours):
    return Triangles(np.asarray(vertices, float), np.asarray(faces, np.int64), **colours)


def write_ply(path: Path, vertices, faces, colours=None):
    """An ASCII ply file, with colours (V, 3) of vertices if they are given."""
    extra = ["property uchar red", "property uchar green", "property uchar blue"] if colours is not None else []
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {a}" for a in "xyz"] + extra
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    for k, v in enumerate(vertices):
        lines.append(
            " ".join(map(repr, map(float, v))) + ("" if colours is None else " " + " ".join(map(str, colours[k])))
        )
    lines += [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_obj(path: Path, vertices, faces):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices, float).tolist()]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in np.asarray(faces).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_textured_obj(folder: Path, name: str, half, image):
    """A box whose four sides and both ends show the whole image."""
    import cv2

    vertices, faces = box_mesh(half)
    cv2.imwrite(str(folder / f"{name}.png"), image[..., ::-1])
    (folder / f"{name}.mtl").write_text(f"newmtl skin\nKd 1 1 1\nmap_Kd {name}.png\n", encoding="utf-8")
    lines = [f"mtllib {name}.mtl", "usemtl skin"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    for k, face in enumerate(faces.tolist()):
        uv = (1, 2, 3) if k % 2 == 0 else (1, 3, 4)
        lines.append("f " + " ".join(f"{i + 1}/{t}" for i, t in zip(face, uv, strict=True)))
    (folder / f"{name}.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")


def five_objects(folder: Path) -> Path:
    """A folder with a box, a cup, a can, a textured box and a box in a glTF file."""
    import trimesh

    folder.mkdir()
    vertices, faces = box_mesh((0.04, 0.03, 0.07))
    write_ply(folder / "tin.ply", vertices, faces, np.tile([[200, 60, 40]], (8, 1)))
    write_obj(folder / "cup.obj", *cup_mesh())
    trimesh.Trimesh(*lathe_mesh([(0, 0), (0.035, 0), (0.035, 0.10), (0, 0.10)]), process=False).export(
        folder / "can.stl"
    )
    image = np.zeros((32, 32, 3), np.uint8)
    image[:16], image[16:] = (250, 20, 20), (20, 20, 250)
    write_textured_obj(folder, "carton", (0.03, 0.05, 0.08), image)
    block = trimesh.Trimesh(*box_mesh((0.03, 0.06, 0.03)), process=False)  # y is up in glTF: 12 cm high
    block.visual.vertex_colors = np.tile([[30, 160, 60, 255]], (8, 1))
    block.export(folder / "block.glb")
    return folder
