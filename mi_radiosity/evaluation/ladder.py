"""How time and memory grow with faces: furnished rooms of 1e3 to 1e6 triangles, all lit alike.

python -m mi_radiosity.evaluation.ladder [TRIANGLES …] [--rays N] [--variant VARIANT]
"""

import argparse
import json
import subprocess
import sys
import time
from typing import Any

import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..scene import Model
from ..solver import solve
from .records import peak_megabytes

TRIANGLES = (1_000, 10_000, 100_000, 1_000_000)
RAYS = 10_000_000
MORE = 19_000  # elements more than patches
TABLES = 6, 5  # along the room and across
SIZE = np.array([9.0, 7.5, 3.0])  # of the room, m


def room(triangles: int) -> "mi.Scene":
    """A room with thirty tables, balls on them and a lamp, of about so many triangles."""
    places = [
        SIZE[:2] * [(k + 0.5) / TABLES[0], (m + 0.5) / TABLES[1]] for k in range(TABLES[0]) for m in range(TABLES[1])
    ]
    # A table is five boxes of 12 n² triangles, a ball one of 12 (2 n)², drawn onto a sphere.
    n = max(1, round((triangles / len(places) / (5 * 12 + 48)) ** 0.5))
    box = _box(n)
    legs = [([x, y, 0.35], [0.03, 0.03, 0.35]) for x in (-0.5, 0.5) for y in (-0.3, 0.3)]
    tables, balls = [], []
    for place in places:
        at = np.append(place, 0.0)
        tables += [_moved(box, at + middle, half) for middle, half in [([0, 0, 0.72], [0.6, 0.4, 0.02]), *legs]]
        vertices, faces = _box(2 * n)
        balls.append((at + [0.2, 0.1, 0.9] + 0.15 * vertices / np.linalg.norm(vertices, axis=1)[:, None], faces))
    walls = _moved(_box(1), SIZE / 2, SIZE / 2)
    panel = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.8 + SIZE * [0.5, 0.5, 0.99]
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 10.0}}
    return mi.load_dict(
        {
            "type": "scene",
            "walls": _mesh([(walls[0], walls[1][:, ::-1])], 0.7),
            "tables": _mesh(tables, 0.4),
            "balls": _mesh(balls, 0.6),
            "lamp": _mesh([(panel, np.array([[0, 2, 1], [0, 3, 2]]))], 0.2, glow),
        },
        optimize=False,
    )


def _box(n):
    """Vertices and faces of a box from −1 to 1 whose sides are n × n squares; normals point outwards."""
    line = np.linspace(-1, 1, n + 1)
    a, b = (x.ravel() for x in np.meshgrid(line, line, indexing="ij"))
    k = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    low, right, up, high = k[:-1, :-1].ravel(), k[1:, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, 1:].ravel()
    side = np.concatenate([np.column_stack([low, right, high]), np.column_stack([low, high, up])])
    vertices, faces = [], []
    for axis in range(3):
        for sign in (-1, 1):
            points = np.empty((len(a), 3))
            points[:, axis], points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = sign, a, b
            faces.append((side if sign > 0 else side[:, ::-1]) + len(vertices) * len(a))
            vertices.append(points)
    return np.concatenate(vertices), np.concatenate(faces)


def _moved(part, middle, half):
    return part[0] * half + middle, part[1]


def _mesh(parts, reflectance, emitter=None):
    """One mesh of parts (vertices, faces)."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, starts)])
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}})
    if emitter:
        properties["emitter"] = mi.load_dict(emitter)
    mesh = mi.Mesh("", len(vertices), len(faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def climb(triangles: int, rays: int) -> dict[str, Any]:
    """Seconds of reading and solving a room of so many triangles, kernels being there, and the peak of memory."""
    solve(room(1_000), elements=4_000, rays=200_000)
    scene = room(triangles)
    start = time.perf_counter()
    model = Model(scene)
    read = time.perf_counter() - start
    solution = solve(model, elements=model.patches.count + MORE, rays=rays)
    total = time.perf_counter() - start
    return {
        "faces": len(model.faces),
        "patches": model.patches.count,
        "elements": solution.stats["elements"],
        "rays": solution.stats["rays"],
        "read_seconds": read,
        "solve_seconds": total - read,
        "megabytes": peak_megabytes(),
    }


def main(argv: list[str] | None = None) -> None:
    """Print a row per size, each measured in a process of its own."""
    parser = argparse.ArgumentParser(description="time and memory against the number of faces")
    parser.add_argument("triangles", type=int, nargs="*", default=TRIANGLES)
    parser.add_argument("--rays", type=int, default=RAYS)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.one:
        mi.set_variant(arguments.variant)
        print(json.dumps(climb(arguments.triangles[0], arguments.rays)))
        return
    print(f"{'faces':>10} {'patches':>10} {'elements':>10} {'rays':>12} {'read, s':>8} {'solve, s':>8} {'MB':>7}")
    for triangles in arguments.triangles:
        command = [sys.executable, "-m", __spec__.name, "--one", str(triangles), "--rays", str(arguments.rays)]
        run = subprocess.run([*command, "--variant", arguments.variant], capture_output=True, text=True)
        if run.returncode:
            why = (run.stderr.strip() or f"status {run.returncode}").splitlines()[-1]
            raise RadiosityError(f"the room of {triangles} triangles failed: {why}")
        row = json.loads(run.stdout.splitlines()[-1])
        print(
            f"{row['faces']:>10,} {row['patches']:>10,} {row['elements']:>10,} {row['rays']:>12,} "
            f"{row['read_seconds']:>8.2f} {row['solve_seconds']:>8.2f} {row['megabytes']:>7,.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
