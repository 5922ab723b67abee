"""What a comparison asks and what it finds: questions, budgets, rows of results."""

import json
import math
import statistics
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypedDict, cast

from ..core.errors import RadiosityError
from ..core.files import writing

PAPER = "ks,gmi:1.5,gmi:1.25,mi,gmi:0.75,gmi:0.5"  # the rows of table 1
QUESTIONS = {
    "mesh": "as many elements and as many power rays (the paper's question)",
    "rays": "as many rays in all: power, oracle and pilot rays together",
    "time": "as much time for the whole solve",
    "noise": "the same meshes with 16 times the power rays: what the meshes alone cost",
}
MORE_RAYS = 16
METRICS = {"rmse_a": "RMSE_a", "rmse_p": "RMSE_p", "psnr_a": "PSNR_a", "psnr_p": "PSNR_p"}


class Costs(TypedDict):
    """What a solve cost."""

    elements: int
    pairs: int
    rays: int
    oracle_rays: int
    pilot_rays: int
    seconds: float


class Row(Costs):
    """One solve seen from one view: which it is, its costs, and its errors as in `metrics.Errors`."""

    key: str
    question: str
    elements_wanted: int
    label: str
    oracle: str
    alpha: float | None
    seed: int
    view: int
    shading: str
    rmse_a: float
    rmse_p: float
    psnr_a: float
    psnr_p: float
    rel_mse: float
    rmse_a_clean: float
    rmse_a_clean_error: float


class Results(TypedDict):
    """A comparison, as results.json has it."""

    scene: str
    setting: dict[str, Any]
    versions: dict[str, str]
    reference: dict[str, dict[str, Any]]
    rows: list[Row]
    missing: dict[str, str]


def costs(stats: dict[str, Any]) -> Costs:
    """The costs among the stats of a solution."""
    return cast(Costs, {name: stats[name] for name in Costs.__annotations__} | {"seconds": stats["seconds"]["total"]})


def fell_short(row: Row) -> bool:
    """Has the mesh fewer elements than were asked for? Solves reach that number to within 3."""
    return row["elements"] < row["elements_wanted"] - 2


def cost(row: Costs, question: str) -> float:
    """What the question makes equal: rays in all, or seconds."""
    return row["seconds"] if question == "time" else row["rays"] + row["oracle_rays"] + row["pilot_rays"]


def common_budget(rows: Iterable[Row], labels: Iterable[str], question: str) -> float:
    """What the costliest oracle spent on average for the first question: the budget of all in the others."""
    spent = [[cost(r, question) for r in select(rows, "mesh", label)] for label in labels]
    return max((statistics.mean(s) for s in spent if s), default=0.0)


def select(rows: Iterable[Row], question: str, label: str, view: int | None = None) -> list[Row]:
    """Rows of one question and oracle, from one view or all."""
    return [r for r in rows if r["question"] == question and r["label"] == label and view in (None, r["view"])]


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half-width of its 95 % confidence interval (Student's t; NaN for one value, or an infinite mean, which
    is the PSNR of pictures that are the same)."""
    from scipy.stats import t

    mean = statistics.mean(values)
    if len(values) < 2 or not math.isfinite(mean):
        return mean, float("nan")
    return mean, float(t.ppf(0.975, len(values) - 1)) * statistics.stdev(values) / len(values) ** 0.5


# ---- Files -----------------------------------------------------------------------------------------


def write(path: Path, data: str | bytes) -> None:
    """Write a file whole or not at all."""
    with writing(path) as temporary:
        Path(temporary).write_bytes(data.encode() if isinstance(data, str) else data)


def peak_megabytes() -> float:
    """The most memory that this process has had; not a number where the system does not tell."""
    if sys.platform == "win32":
        return float("nan")
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def make_folder(path: Path) -> None:
    """Make a folder for output, or raise RadiosityError that says why not."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RadiosityError(f"cannot write into {path} ({error.strerror}): choose another folder") from None


def save(output: Path, results: Results) -> None:
    """Keep results in a folder."""
    write(output / "results.json", json.dumps(results, indent=1) + "\n")


def resume(output: Path, fresh: Results) -> Results:
    """Results kept in a folder if they have the setting of ``fresh``, which is returned if there are none.

    Raises RadiosityError if the file is damaged or answers other questions.
    """
    file = output / "results.json"
    if not file.exists():
        return fresh
    try:
        kept = json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        raise RadiosityError(f"{file} is damaged: remove it to start over") from None
    if kept.get("setting") != fresh["setting"]:
        raise RadiosityError(f"{output} holds a comparison with other settings: choose another folder, or remove it")
    for row in kept["rows"]:  # earlier versions refused meshes with fewer elements
        row.setdefault("elements_wanted", row["elements"])
    return kept


def picture_file(output: Path, label: str, view: int, mesh: bool = False) -> Path:
    """Where the picture of an oracle's solution is kept."""
    return output / "images" / f"{label}_view{view}{'_mesh' * mesh}.exr".replace(":", "")
