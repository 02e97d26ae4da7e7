"""Meshes and object files for the tests."""

import numpy as np
import trimesh

from tests.helpers.grasps import DATA

HEAD = (DATA / "box.toml").read_text().split("[[object]]")[0]


def box(*sizes):
    return trimesh.creation.box(sizes or (0.04, 0.05, 0.06))


def bracket():
    """An L, not convex: two boxes that share no inner wall."""
    outline = np.array([[22, 22], [22, 64], [0, 64], [0, 0], [64, 0], [64, 22.0]]) / 1e3
    vertices = np.array([[x, y, z] for y in (0, 0.044) for x, z in outline])
    fan = [[0, k, k + 1] for k in range(1, 5)]
    sides = [[k, 6 + k, (k + 1) % 6] for k in range(6)]
    sides += [[(k + 1) % 6, 6 + k, 6 + (k + 1) % 6] for k in range(6)]
    faces = np.array([*fan, *(6 + np.array(fan)[:, ::-1]), *sides])
    return trimesh.Trimesh(vertices, faces)


def object_file(tmp_path, *entries, name="objects.toml"):
    """An object file with entries as TOML lines, joined by semicolons."""
    text = HEAD + "".join("\n[[object]]\n" + "\n".join(e.split("; ")) + "\n" for e in entries)
    (tmp_path / name).write_text(text)
    return tmp_path / name
