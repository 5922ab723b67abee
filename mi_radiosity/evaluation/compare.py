"""Refinement oracles compared: the same scene, elements, rays and views, error beside cost."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..core.errors import RadiosityError
from ..core.numbers import whole_number
from ..display import SHADERS, write_image
from ..oracles import parse
from ..scene import Model
from . import require_extra
from .cells import Cell, Pictures, Study, executor_for, run_cells
from .page import page
from .plots import pictures_and_errors
from .records import PAPER, QUESTIONS, Results, Row, common_budget, make_folder, picture_file, resume, save, write
from .reference import Reference, cached_reference, identity, versions
from .scenes import scene_file
from .tables import markdown, report


def compare_oracles(
    path: str | Path,
    output: str | Path,
    *,
    variant: str | None = None,
    definitions: Mapping[str, str] | None = None,
    plugins: Iterable[str] = (),
    oracles: str = PAPER,
    elements: int = 19_000,
    rays: int = 2_684_000,
    lines: int = 10,
    seeds: int = 5,
    views: Sequence[int] = (0,),
    spp: int = 64,
    shading: str = "gouraud",
    reference_spp: int = 1024,
    questions: Iterable[str] = tuple(QUESTIONS),
    scheduler: str | None = None,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Results:
    """Compare oracles on a scene and write table.md, results.json, figure.png and report.html into ``output``.

    Rows that results.json already holds for the same scene and budgets are not computed again.
    Raises RadiosityError for what the user can mend.
    """
    require_extra()
    elements, rays, lines = (
        whole_number(name, n) for name, n in (("elements", elements), ("rays", rays), ("lines", lines))
    )
    spp, seeds = whole_number("spp", spp), whole_number("seeds", seeds)
    reference_spp, views = whole_number("reference_spp", reference_spp), [whole_number("view", v, 0) for v in views]
    output, file = Path(output), scene_file(path, variant, definitions, plugins)
    file.prepare()
    questions, labels = _known_questions(questions), _known_oracles(oracles)
    SHADERS.find(shading)
    make_folder(output)
    executor, model = executor_for(scheduler), file.model()
    references = {view: cached_reference(model, view, output, reference_spp, progress) for view in views}
    files = tuple(str(references[view][1].resolve()) for view in views)
    study = Study(file, elements, rays, lines, spp, shading, tuple(views), files)
    results = resume(output, _fresh(study, model, {view: r for view, (r, _) in references.items()}))
    results["missing"] = {}
    for question in questions:
        cells = _cells(study, labels, seeds, question, results["rows"])
        failed = run_cells(
            cells, executor, partial(_keep, output, results), partial(progress, f"compare: same {question}")
        )
        results["missing"] |= {cell.key: str(error) for cell, error in failed.items()}
    save(output, results)
    _write_report(output, results, labels, {view: r for view, (r, _) in references.items()})
    _complain(results["missing"])
    return results


def _known_questions(questions: Iterable[str]) -> list[str]:
    """Questions in the order they build on each other."""
    questions = list(questions)
    if unknown := [q for q in questions if q not in QUESTIONS]:
        raise RadiosityError(f"unknown question '{unknown[0]}': choose from {', '.join(QUESTIONS)}")
    if "mesh" not in questions:
        raise RadiosityError("the other questions are measured against 'mesh': ask it, too")
    return [q for q in QUESTIONS if q in questions]


def _known_oracles(texts: str) -> list[str]:
    labels = list(dict.fromkeys(text.strip() for text in texts.split(",")))
    for label in labels:
        parse(label)
    return labels


def _fresh(study: Study, model: Model, references: dict[int, Reference]) -> Results:
    """Results without rows; rows of another run are theirs, too, if its ``setting`` is the same."""
    sensors = model.scene.sensors()
    names = ("elements", "rays", "lines", "spp", "shading")
    setting: dict[str, Any] = {name: getattr(study, name) for name in names} | {
        "fingerprint": model.fingerprint,
        "views": list(study.views),
        "references": {str(v): identity(model, sensors[v]) | {"spp": sum(r.spp)} for v, r in references.items()},
    }
    return {
        "scene": Path(study.scene.path).name,
        "setting": setting,
        "versions": versions(),
        "reference": {
            str(view): {"file": Path(file).name, "spp": sum(r.spp), "noise": r.noise()}
            for (view, r), file in zip(references.items(), study.references, strict=True)
        },
        "rows": [],
        "missing": {},
    }


def _cells(study: Study, labels: list[str], seeds: int, question: str, rows: list[Row]) -> list[Cell]:
    """What is still to be solved for a question."""
    budget = 0.0 if question in ("mesh", "noise") else common_budget(rows, labels, question)
    if question == "noise":
        seeds = min(seeds, 2)
    done = {row["key"] for row in rows}
    cells = [Cell(study, label, seed, question, budget) for seed in range(seeds) for label in labels]
    return [cell for cell in cells if cell.key not in done]


def _keep(output: Path, results: Results, cell: Cell, found: tuple[list[Row], Pictures]) -> None:
    """Add what a cell found to the results on disk."""
    rows, pictures = found
    results["rows"] += rows
    for (view, mesh), image in pictures.items():
        file = picture_file(output, cell.oracle, view, mesh)
        make_folder(file.parent)
        write_image(file, mi.TensorXf(image))
    save(output, results)


def _write_report(output: Path, results: Results, labels: list[str], references: dict[int, Reference]) -> None:
    found = report(results, labels)
    figure = pictures_and_errors(output, labels, {view: r.image() for view, r in references.items()})
    write(output / "table.md", markdown(found))
    write(output / "figure.png", figure)
    write(output / "report.html", page(found, figure))


def _complain(missing: dict[str, str]) -> None:
    if missing:
        key, error = next(iter(missing.items()))
        raise RadiosityError(
            f"{len(missing)} cells failed twice ({key}: {error}); "
            "the others are kept: run the same comparison again to try once more"
        )
