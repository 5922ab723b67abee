"""Results of a comparison as sentences and tables: data first, then Markdown."""

import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from .records import METRICS, MORE_RAYS, QUESTIONS, Results, Row, cost, fell_short, interval, select

SHORT = "†"  # marks oracles that found nothing left to refine before the mesh had the elements wanted


class Entry(NamedTuple):
    """One cell of a table; ``best`` ones are set in bold."""

    text: str
    best: bool = False


@dataclass(frozen=True)
class Table:
    """A table under a title (or none) and a note (or none)."""

    head: list[str]
    rows: list[list[Entry]]
    title: str = ""
    note: str = ""


class Verdict(NamedTuple):
    """Who wins, given something."""

    given: str
    text: str


@dataclass(frozen=True)
class Report:
    """All that is said of a comparison."""

    title: str
    verdicts: list[Verdict]
    notes: list[str]
    tables: list[Table]
    footer: str


def report(results: Results, labels: Sequence[str]) -> Report:
    """What the results say of the oracles ``labels``."""
    setting = results["setting"]
    present = {q: [label for label in labels if select(results["rows"], q, label)] for q in QUESTIONS}
    return Report(
        f"Oracles compared on {results['scene']}",
        [_verdict(results, q, present[q]) for q in ("mesh", "rays", "time") if len(present[q]) > 1],
        [
            f"Reference of view {view}: {r['spp']} samples per pixel, its own RMSE_a is {r['noise']:.3f}."
            for view, r in results["reference"].items()
        ]
        + _shortfalls(results["rows"], labels),
        list(_tables(results, present)),
        f"Versions: {', '.join(f'{k} {v}' for k, v in results['versions'].items())}. "
        f"{setting['elements']:,} elements, {setting['rays']:,} rays, {setting['lines']} lines per pair, "
        f"{setting['shading']} shading.",
    )


def markdown(found: Report) -> str:
    """The report as Markdown."""
    blocks = [f"# {found.title}", *(f"**{v.given}:** {v.text}" for v in found.verdicts), "\n".join(found.notes)]
    for table in found.tables:
        blocks += [f"## {table.title}"] if table.title else []
        blocks += [table.note] if table.note else []
        rows = [[f"**{entry.text}**" if entry.best else entry.text for entry in row] for row in table.rows]
        lines = [table.head, ["---"] * len(table.head), *rows]
        blocks.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
    return "\n\n".join([*blocks, found.footer]) + "\n"


def _shortfalls(rows: Sequence[Row], labels: Sequence[str]) -> list[str]:
    """A note on oracles whose meshes have fewer elements than were asked for (none or one)."""
    short = [r for label in labels for r in rows if r["label"] == label and fell_short(r)]
    found = {r["label"]: f"{r['label']} {r['elements']:,} of {r['elements_wanted']:,}" for r in reversed(short)}
    if not found:
        return []
    return [
        f"{SHORT} Fewer elements than asked for, because there was nothing left to refine: {', '.join(found.values())}."
    ]


def _marked(rows: Sequence[Row], question: str, label: str) -> str:
    """The label of an oracle, marked if one of its meshes has fewer elements than were asked for."""
    return f"{label} {SHORT}" if any(map(fell_short, select(rows, question, label))) else label


# ---- Sentences -------------------------------------------------------------------------------------


def _mean(rows: Iterable[Row], name: str) -> float:
    return statistics.mean(row[name] for row in rows)  # type: ignore[literal-required]


def _verdict(results: Results, question: str, labels: Sequence[str]) -> Verdict:
    """Who wins, by how much, at what cost, and whether that is decided."""
    rows, views = results["rows"], results["setting"]["views"]

    def mean(label, name, view=None):
        return _mean(select(rows, question, label, view), name)

    ranked = sorted(labels, key=lambda label: mean(label, "rmse_a_clean"))
    best, second = ranked[:2]
    base = "ks" if "ks" in ranked[1:] else ranked[-1]
    undecided = [other for other in ranked[1:] if not all(_decided(rows, question, best, other, v) for v in views)]
    ratios = " and ".join(
        " and ".join(f"{_ratio(mean(best, 'rmse_a_clean', v), mean(other, 'rmse_a_clean', v)):.2f}" for v in views)
        + f" of {other}'s"
        for other in dict.fromkeys((base, second))
    )
    return Verdict(
        f"Given {QUESTIONS[question]}",
        f"{best} {'leads' if second in undecided else 'wins'}. Its RMSE_a is {ratios} "
        f"({'by view, ' if len(views) > 1 else ''}the reference's noise removed), "
        f"for {mean(best, 'oracle_rays') / max(mean(base, 'oracle_rays'), 1):.1f} times the oracle rays "
        f"and {mean(best, 'seconds') / mean(base, 'seconds'):.2f} times the seconds of {base}. " + _doubts(undecided),
    )


def _ratio(error: float, other: float) -> float:
    """One error over another; 1 if neither is more than 0, as in pictures of black scenes."""
    return error / other if other else 1.0 if error == 0 else math.inf


def _doubts(undecided: Sequence[str]) -> str:
    if not undecided:
        return "All differences from it are decided."
    return f"Undecided, by the intervals or the reference's noise: {', '.join(undecided)}."


def _decided(rows: Sequence[Row], question: str, a: str, b: str, view: int) -> bool:
    """Do 95 % intervals of two oracles stay apart, the noise of the reference added to each?"""
    (x, dx), (y, dy) = (_spread(select(rows, question, label, view)) for label in (a, b))
    return abs(x - y) > dx + dy


def _spread(rows: Sequence[Row]) -> tuple[float, float]:
    """Mean clean error, and how far it may be off."""
    mean, half = interval([r["rmse_a_clean"] for r in rows])
    return mean, (half if len(rows) > 1 else 0.0) + 1.96 * _mean(rows, "rmse_a_clean_error")


# ---- Tables ----------------------------------------------------------------------------------------


def _tables(results: Results, present: dict[str, list[str]]) -> Iterator[Table]:
    """The paper's layout per question, costs, and error split into mesh and noise."""
    rows, views = results["rows"], results["setting"]["views"]
    for question in ("mesh", "rays", "time"):
        if present[question]:
            yield _errors(rows, present[question], question, views)
            yield _costs(rows, present[question], question)
    if present["noise"]:
        yield _split(rows, present["noise"], views)


def _errors(rows: Sequence[Row], labels: Sequence[str], question: str, views: Sequence[int]) -> Table:
    columns = [
        _column([[r[name] for r in select(rows, question, label, view)] for label in labels], name)  # type: ignore[literal-required]
        for view in views
        for name in METRICS
    ]
    return Table(
        ["oracle"] + [f"{heading} (view {view})" for view in views for heading in METRICS.values()],
        [[Entry(_marked(rows, question, label)), *entries] for label, *entries in zip(labels, *columns, strict=True)],
        f"Given {QUESTIONS[question]}",
    )


def _column(values: Sequence[Sequence[float]], name: str) -> list[Entry]:
    """Means of one metric with their intervals, one list of values per oracle."""
    found = [interval(v) for v in values]
    means = [mean for mean, _ in found]
    best = (min if name.startswith("rmse") else max)(means)
    return [Entry(f"{mean:.3f}" + ("" if math.isnan(half) else f" ± {half:.3f}"), mean == best) for mean, half in found]


def _costs(rows: Sequence[Row], labels: Sequence[str], question: str) -> Table:
    names = ("elements", "pairs", "rays", "oracle_rays", "pilot_rays")

    def line(label):
        own = select(rows, question, label)
        counts = [_mean(own, name) for name in names] + [statistics.mean(cost(r, "rays") for r in own)]
        mark = _marked(rows, question, label)
        return [mark, *(f"{count:,.0f}" for count in counts), f"{_mean(own, 'seconds'):.2f}"]

    return Table(
        ["oracle", *(name.replace("_", " ") for name in names), "rays in all", "seconds"],
        [[Entry(text) for text in line(label)] for label in labels],
    )


def _split(rows: Sequence[Row], labels: Sequence[str], views: Sequence[int]) -> Table:
    parts = ("RMSE_a", "of the mesh", "of the rays")
    return Table(
        ["oracle"] + [f"{name} (view {view})" for view in views for name in parts],
        [
            [Entry(_marked(rows, "noise", label))] + [Entry(f"{x:.3f}") for v in views for x in split(rows, label, v)]
            for label in labels
        ],
        "Where the error comes from",
        "RMSE_a² with the noise of the reference removed, split by rendering the same meshes with "
        f"{MORE_RAYS} times the power rays.",
    )


def split(rows: Sequence[Row], label: str, view: int) -> tuple[float, float, float]:
    """RMSE_a of an oracle, and its parts: of the mesh, and of the rays (their squares add up)."""
    many = select(rows, "noise", label, view)
    seeds = {r["seed"] for r in many}
    few = [r for r in select(rows, "mesh", label, view) if r["seed"] in seeds]
    whole, rest = (statistics.mean(r["rmse_a_clean"] ** 2 for r in part) for part in (few, many))
    noise = min(max(whole - rest, 0) * MORE_RAYS / (MORE_RAYS - 1), whole)
    return whole**0.5, (whole - noise) ** 0.5, noise**0.5
