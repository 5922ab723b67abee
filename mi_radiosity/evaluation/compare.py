"""Refinement oracles compared: the same scene, elements, rays and views, error beside cost."""

import functools
import json
import statistics
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.files import writing
from ..oracles import make_oracle
from ..scene import Model
from ..solver import solve
from .metrics import compare
from .reference import Reference, identity, render_reference, versions

PAPER = "ks,gmi:1.5,gmi:1.25,mi,gmi:0.75,gmi:0.5"  # the rows of table 1
QUESTIONS = {
    "mesh": "as many elements and as many power rays (the paper's question)",
    "rays": "as many rays in all: power, oracle and pilot rays together",
    "time": "as much time for the whole solve",
    "noise": "the same meshes with 16 times the power rays: what the meshes alone cost",
}
MORE_RAYS = 16
METRICS = ("rmse_a", "rmse_p", "psnr_a", "psnr_p")


@dataclass(frozen=True)
class Cell:
    """One solve of a comparison, seen from every view: what a worker needs to know.

    ``question``: "mesh" for the budgets as given; "noise" for MORE_RAYS times the rays on the same mesh;
    "rays" or "time" to spend ``budget`` (rays in all, or seconds) by growing elements and rays together.
    """

    scene: str
    variant: str
    definitions: tuple
    oracle: str
    seed: int
    elements: int
    rays: int
    lines: int
    spp: int
    views: tuple
    references: tuple
    question: str = "mesh"
    budget: float = 0.0
    pictures: bool = False

    @property
    def key(self):
        return f"{self.question} {self.oracle} {self.seed}"


def parse_oracle(text):
    """'gmi:0.75' or 'ks' as (name, alpha or None)."""
    name, colon, alpha = text.strip().partition(":")
    try:
        return name, float(alpha) if colon else None
    except ValueError:
        raise RadiosityError(f"--oracles {text}: write gmi with its index as gmi:0.5") from None


_warm = set()  # what this process has compiled


@functools.lru_cache(maxsize=2)
def _scene(path, variant, definitions, changed):
    if mi.variant() != variant:
        mi.set_variant(variant)
    scene = mi.load_file(path, optimize=False, **dict(definitions))
    return scene, Model(scene)


@functools.lru_cache(maxsize=32)
def _halves(path, changed):
    return Reference.load(path).halves()


def run_cell(cell):
    """Solve one Cell and measure it: (rows, pictures); runs in any process that sees the files."""
    from ..display import render

    stamp = Path(cell.scene).stat().st_mtime_ns
    _, model = _scene(cell.scene, cell.variant, cell.definitions, stamp)
    oracle = make_oracle(*parse_oracle(cell.oracle))
    solution = _spend(cell, model, oracle)
    stats = solution.stats
    rows, pictures = [], {}
    for view, reference in zip(cell.views, cell.references):
        image = np.array(render(solution, view, spp=cell.spp))[..., :3]
        errors = compare(image, _halves(reference, Path(reference).stat().st_mtime_ns))
        rows.append(
            {
                "question": cell.question,
                "view": view,
                "oracle": oracle.name,
                "alpha": oracle.alpha,
                "seed": cell.seed,
                "elements": stats["elements"],
                "pairs": stats["pairs"],
                "rays": stats["rays"],
                "oracle_rays": stats["oracle_rays"],
                "pilot_rays": stats["pilot_rays"],
                "seconds": stats["seconds"]["total"],
                **errors.asdict(),
                "key": cell.key,
                "label": cell.oracle,
            }
        )
        if cell.pictures:
            pictures[f"{cell.oracle}_view{view}"] = image.astype(np.float32)
            pictures[f"{cell.oracle}_view{view}_mesh"] = np.array(render(solution, view, spp=16, shading="mesh"))[
                ..., :3
            ].astype(np.float32)
    return rows, pictures


def _spend(cell, model, oracle):
    """Solve with the budget of the cell's question."""

    def run(elements, rays):
        return solve(
            model,
            oracle,
            elements=max(model.count, int(elements)),
            rays=max(1, int(rays)),
            lines=cell.lines,
            seed=cell.seed,
        )

    if (cell.oracle, cell.scene) not in _warm:  # compile first, so that seconds are warm
        run(cell.elements, cell.rays // 10)
        _warm.add((cell.oracle, cell.scene))
    solution = run(cell.elements, cell.rays * (MORE_RAYS if cell.question == "noise" else 1))
    if cell.question in ("mesh", "noise"):
        return solution
    elements, rays = cell.elements, cell.rays
    for _ in range(2):  # costs are not quite proportional
        factor = cell.budget / cost(solution.stats, cell.question)
        elements, rays = elements * factor, rays * factor
        solution = run(elements, rays)
    stats = solution.stats
    if cell.question == "rays":
        rest = cell.budget - stats["oracle_rays"] - stats["pilot_rays"]
    else:
        seconds = stats["seconds"]
        rest = stats["rays"] * (1 + (cell.budget - seconds["total"]) / max(seconds["distribute"], 1e-3))
    return run(elements, max(rest, 0.1 * stats["rays"]))


def cost(stats, question):
    """Rays in all, or seconds, of a solve (stats or a row of results)."""
    if question == "rays":
        return stats["rays"] + stats["oracle_rays"] + stats["pilot_rays"]
    return stats["seconds"] if isinstance(stats["seconds"], float) else stats["seconds"]["total"]


# ---- Running ---------------------------------------------------------------------------------------


class InProcess(Executor):
    """An Executor that works where it stands."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def executor_for(scheduler):
    """Where cells run: in this process, or on the Dask cluster at ``scheduler``."""
    if scheduler is None:
        return InProcess()
    try:
        from distributed import Client
    except ImportError:
        raise RadiosityError("--scheduler needs Dask: pip install 'mi_radiosity[dask]'") from None
    try:
        return Client(scheduler, timeout="5s").get_executor(retries=0)
    except (OSError, ValueError) as error:
        raise RadiosityError(f"no Dask scheduler answers at {scheduler} ({error}): check the address") from None


def run_cells(cells, executor, finished, progress=lambda done, total: None, work=run_cell):
    """Run ``work(cell)`` through a concurrent.futures.Executor, telling ``finished(cell, result)`` of each.

    A cell whose worker fails is tried once more; if that fails too the run goes on without it.
    Returns {cell: error} of the cells that are missing. RadiosityError ends the run.
    """
    queue, pending, tried, failed = list(cells), {}, set(), {}
    most = 1 if isinstance(executor, InProcess) else len(cells)
    while queue or pending:
        while queue and len(pending) < most:
            cell = queue.pop(0)
            pending[executor.submit(work, cell)] = cell
        for future in wait(pending, return_when=FIRST_COMPLETED).done:
            cell, error = pending.pop(future), future.exception()
            if error is None:
                finished(cell, future.result())
            elif isinstance(error, RadiosityError):
                raise error
            elif cell in tried:
                failed[cell] = error
            else:
                tried.add(cell)
                queue.append(cell)
        progress(len(cells) - len(queue) - len(pending), len(cells))
    return failed


# ---- A whole comparison ----------------------------------------------------------------------------


def compare_oracles(
    path,
    output,
    *,
    variant="llvm_ad_rgb",
    definitions=(),
    oracles=PAPER,
    elements=19_000,
    rays=2_684_000,
    lines=10,
    seeds=5,
    views=(0,),
    spp=64,
    reference_spp=1024,
    questions=tuple(QUESTIONS),
    scheduler=None,
    progress=lambda stage, done, total: None,
):
    """Compare oracles on a scene and write table.md, results.json, figures and report.html into ``output``.

    Rows that results.json already holds for the same scene and budgets are not computed again.
    Returns the results (dict). Raises RadiosityError for what the user can mend.
    """
    from .report import write_report

    path, output = Path(path).resolve(), Path(output)
    labels = [text.strip() for text in oracles.split(",")]
    for label in labels:
        make_oracle(*parse_oracle(label))
    scene, model = _scene(str(path), variant, tuple(definitions), path.stat().st_mtime_ns)
    references = {view: cached_reference(model, scene, view, output, reference_spp, progress) for view in views}
    setting = {
        "fingerprint": model.fingerprint,
        "elements": elements,
        "rays": rays,
        "lines": lines,
        "spp": spp,
        "views": list(views),
        "references": {
            str(v): identity(model, scene.sensors()[v]) | {"spp": sum(r.spp)} for v, (r, _) in references.items()
        },
    }
    results = _resume(output, setting, str(path.name))
    results["reference"] = {
        str(view): {"file": file.name, "spp": sum(r.spp), "noise": r.noise()} for view, (r, file) in references.items()
    }
    executor = executor_for(scheduler)

    def cells(question, budget=0.0):
        return [
            Cell(
                str(path),
                variant,
                tuple(definitions),
                label,
                seed,
                elements,
                rays,
                lines,
                spp,
                tuple(views),
                tuple(str(references[v][1].resolve()) for v in views),
                question,
                budget,
                pictures=question == "mesh" and seed == 0,
            )
            for seed in range(min(seeds, 2) if question == "noise" else seeds)
            for label in labels
        ]

    def finished(cell, result):
        rows, pictures = result
        results["rows"] += rows
        for name, image in pictures.items():
            _save_picture(output / "images" / f"{name}.exr".replace(":", ""), image)
        _save_results(output, results)

    missing = {}
    for question in questions:
        budget = 0.0 if question in ("mesh", "noise") else _common_budget(results["rows"], labels, question)
        todo = [c for c in cells(question, budget) if c.key not in {r["key"] for r in results["rows"]}]
        missing |= run_cells(
            todo, executor, finished, lambda done, total, q=question: progress(f"compare: same {q}", done, total)
        )
    results["missing"] = {cell.key: str(error) for cell, error in missing.items()}
    _save_results(output, results)
    write_report(output, results, labels, {view: r for view, (r, _) in references.items()})
    if missing:
        raise RadiosityError(
            f"{len(missing)} cells failed twice ({next(iter(missing)).key}: {next(iter(missing.values()))}); "
            "the others are kept: run the same command again to try once more"
        )
    return results


def cached_reference(model, scene, view, output, spp, progress):
    """(Reference, file) of a view, from ``output``/references or rendered into it; the name holds what it depends on."""
    sensor = scene.sensors()[view]
    mark = identity(model, sensor)
    folder = output / "references"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RadiosityError(f"cannot write into {output} ({error.strerror}): choose another folder") from None
    file = folder / f"view{view}_{mark['scene'][:12]}_{mark['sensor'][:12]}.exr"
    return render_reference(
        model, sensor, file, spp, progress=lambda done, total: progress(f"reference of view {view}", done, total)
    ), file


def _common_budget(rows, labels, question):
    """What the costliest oracle of the first question spent on average: the budget of everyone in the second."""
    spent = [
        statistics.mean(cost(r, question) for r in rows if r["label"] == label and r["question"] == "mesh")
        for label in labels
        if any(r["label"] == label and r["question"] == "mesh" for r in rows)
    ]
    return max(spent, default=0.0)


def _resume(output, setting, name):
    """Results kept in ``output``, if they answer the same question; else empty ones."""
    fresh = {"scene": name, "setting": setting, "versions": versions(), "reference": {}, "rows": []}
    file = output / "results.json"
    if not file.exists():
        return fresh
    try:
        kept = json.loads(file.read_text())
    except ValueError:
        raise RadiosityError(f"{file} is damaged: remove it to start over") from None
    if kept.get("setting") != setting:
        raise RadiosityError(f"{output} holds a comparison with other settings: choose another -o, or remove it")
    return kept


def _save_results(output, results):
    with writing(output / "results.json") as temporary:
        Path(temporary).write_text(json.dumps(results, indent=1) + "\n")


def _save_picture(path, image):
    from ..display import write_image

    path.parent.mkdir(exist_ok=True)
    write_image(path, mi.TensorXf(image))
