"""One solve of a comparison, and where it runs: in this process or on a Dask cluster."""

import functools
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from ..core.errors import RadiosityError
from ..display import linear_rgb
from ..oracles import parse
from ..solver import Solution, solve
from .metrics import compare
from .records import MORE_RAYS, Row, cost, costs
from .reference import Reference
from .scenes import SceneFile

C = TypeVar("C", bound=Hashable)


@dataclass(frozen=True)
class Study:
    """What all solves of a comparison share."""

    scene: SceneFile
    elements: int
    rays: int
    lines: int
    spp: int  # camera samples per pixel of our pictures
    shading: str
    views: tuple[int, ...]
    references: tuple[str, ...]  # their files, one per view


@dataclass(frozen=True)
class Cell:
    """One solve, seen from every view: what a worker needs to know.

    ``question``: "mesh" for the budgets of the study; "noise" for MORE_RAYS times the rays on the same
    mesh; "rays" or "time" to spend ``budget`` (rays in all, or seconds) by growing elements and rays together.
    """

    study: Study
    oracle: str
    seed: int
    question: str = "mesh"
    budget: float = 0.0

    @property
    def key(self) -> str:
        """Its name among the rows of results."""
        return f"{self.question} {self.oracle} {self.seed}"

    @property
    def pictured(self) -> bool:
        """Are its pictures kept for the figure?"""
        return self.question == "mesh" and self.seed == 0


Pictures = dict[tuple[int, bool], np.ndarray]  # by view, and whether they show the mesh


def run_cell(cell: Cell) -> tuple[list[Row], Pictures]:
    """Solve one Cell and measure it from every view; runs in any process that sees the files."""
    solution = _spend(cell)
    rows: list[Row] = []
    pictures: Pictures = {}
    for view, reference in zip(cell.study.views, cell.study.references, strict=True):
        image = _picture(solution, view, cell.study.spp, cell.study.shading)
        rows.append(_row(cell, solution, view, image, _halves(reference, Path(reference).stat().st_mtime_ns)))
        if cell.pictured:
            pictures[view, False], pictures[view, True] = image, _picture(solution, view, 16, "mesh")
    return rows, pictures


def _picture(solution: Solution, view: int, spp: int, shading: str) -> np.ndarray:
    film = solution.model.scene.sensors()[view].film()
    return linear_rgb(solution.render(view, spp=spp, shading=shading), film)


def _row(cell: Cell, solution: Solution, view: int, image: np.ndarray, halves: np.ndarray) -> Row:
    row = {
        "key": cell.key,
        "question": cell.question,
        "elements_wanted": solution.stats["elements_wanted"],
        "label": cell.oracle,
        "oracle": solution.stats["oracle"],
        "alpha": solution.stats["alpha"],
        "seed": cell.seed,
        "view": view,
        "shading": cell.study.shading,
    }
    return cast(Row, row | dict(costs(solution.stats)) | compare(image, halves).asdict())


@functools.lru_cache(maxsize=32)
def _halves(path: str, changed: int) -> np.ndarray:
    return Reference.load(path).halves()


# ---- Budgets ---------------------------------------------------------------------------------------


def _spend(cell: Cell) -> Solution:
    """A solution that spends the budget of the cell's question."""
    study = cell.study
    _compile(study, cell.oracle)
    if cell.question == "mesh":
        return _solve(cell, study.elements, study.rays)
    if cell.question == "noise":
        return _solve(cell, study.elements, MORE_RAYS * study.rays)
    elements, rays = float(study.elements), float(study.rays)
    solution = _solve(cell, elements, rays)
    for _ in range(2):  # costs are not quite proportional
        factor = cell.budget / cost(costs(solution.stats), cell.question)
        elements, rays = elements * factor, rays * factor
        solution = _solve(cell, elements, rays)
    return _solve(cell, elements, max(_rays_left(cell, solution.stats), 0.1 * solution.stats["rays"]))


def _rays_left(cell: Cell, stats: dict[str, Any]) -> float:
    """Power rays that what the mesh leaves of the budget pays for."""
    if cell.question == "rays":
        return cell.budget - stats["oracle_rays"] - stats["pilot_rays"]
    seconds = stats["seconds"]
    return stats["rays"] * (1 + (cell.budget - seconds["total"]) / max(seconds["distribute"], 1e-3))


def _solve(cell: Cell, elements: float, rays: float) -> Solution:
    model = cell.study.scene.model()
    return solve(
        model,
        parse(cell.oracle),
        elements=max(model.patches.count, int(elements)),
        rays=max(1, int(rays)),
        lines=cell.study.lines,
        seed=cell.seed,
    )


@functools.cache
def _compile(study: Study, oracle: str) -> None:
    """Solve once in this process, so that seconds are warm."""
    _solve(Cell(study, oracle, 0), study.elements, study.rays // 10)


# ---- Running ---------------------------------------------------------------------------------------


class InProcess(Executor):
    """An Executor that works where it stands."""

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> Future:
        """A Future that is done."""
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def executor_for(scheduler: str | None) -> Executor:
    """Where cells run: in this process, or on the Dask cluster at ``scheduler``."""
    if scheduler is None:
        return InProcess()
    try:
        from distributed import Client
    except ImportError:
        raise RadiosityError("a scheduler needs Dask: pip install 'mi_radiosity[dask]'") from None
    try:
        return Client(scheduler, timeout="5s").get_executor(retries=0)
    except (OSError, ValueError) as error:
        raise RadiosityError(f"no Dask scheduler answers at {scheduler} ({error}): check the address") from None


def run_cells(
    cells: Sequence[C],
    executor: Executor,
    finished: Callable[[C, Any], None],
    progress: Callable[[int, int], None] = lambda done, total: None,
    work: Callable[[C], Any] = run_cell,  # type: ignore[assignment]
) -> dict[C, BaseException]:
    """Run ``work(cell)`` through an Executor, telling ``finished(cell, result)`` of each.

    A cell whose worker fails is tried once more; if that fails too the run goes on without it.
    Returns {cell: error} of the cells that are missing. RadiosityError ends the run.
    """
    queue, tried, failed = list(cells), set(), {}
    pending: dict[Future, C] = {}
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
