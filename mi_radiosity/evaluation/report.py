"""Results of a comparison as tables, figures and one page."""

import base64
import html
import io
import math
import re
import statistics
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.files import writing
from .compare import METRICS, MORE_RAYS, QUESTIONS, cost
from .metrics import srgb

HEADINGS = {"rmse_a": "RMSE_a", "rmse_p": "RMSE_p", "psnr_a": "PSNR_a", "psnr_p": "PSNR_p"}
ROWS_OF_FIGURE = ("ks", "mi", "gmi:0.5")  # Fig. 1: KS, GMI_1, GMI_0.5


def write_report(output, results, labels, references):
    """Write table.md, figure.png and report.html of ``results`` into the folder ``output``."""
    tables = "\n\n".join(_tables(results, labels))
    _write(
        output / "table.md",
        f"# Oracles compared on {results['scene']}\n\n"
        + "\n\n".join(verdicts(results, labels))
        + "\n\n"
        + tables
        + "\n",
    )
    figure = _figure(output, labels, references)
    if figure:
        with writing(output / "figure.png") as temporary:
            Path(temporary).write_bytes(figure)
    _write(output / "report.html", _page(results, labels, figure))


def _write(path, text):
    with writing(path) as temporary:
        Path(temporary).write_text(text)


# ---- Numbers ---------------------------------------------------------------------------------------


def interval(values):
    """Mean and half-width of its 95 % confidence interval (Student's t; NaN for one value)."""
    from scipy.stats import t

    mean = statistics.mean(values)
    if len(values) < 2:
        return mean, float("nan")
    return mean, float(t.ppf(0.975, len(values) - 1)) * statistics.stdev(values) / len(values) ** 0.5


def _select(results, question, label, view=None):
    return [
        r for r in results["rows"] if r["question"] == question and r["label"] == label and view in (None, r["view"])
    ]


def _present(results, labels, question):
    return [label for label in labels if _select(results, question, label)]


def verdicts(results, labels):
    """One paragraph per question: who wins, by how much, at what cost, and whether that is decided."""
    questions = [q for q in ("mesh", "rays", "time") if len(_present(results, labels, q)) > 1]
    return [_verdict(results, question, _present(results, labels, question)) for question in questions]


def _verdict(results, question, labels):
    views = results["setting"]["views"]

    def mean(label, name, view=None):
        return statistics.mean(r[name] for r in _select(results, question, label, view))

    def ratios(label, other):
        return " and ".join(f"{mean(label, 'rmse_a_clean', v) / mean(other, 'rmse_a_clean', v):.2f}" for v in views)

    ranked = sorted(labels, key=lambda label: mean(label, "rmse_a_clean"))
    best, second = ranked[:2]
    base = "ks" if "ks" in ranked[1:] else ranked[-1]
    undecided = [other for other in ranked[1:] if not all(_decided(results, question, best, other, v) for v in views)]
    others = [base] if base == second else [base, second]
    text = " and ".join(f"{ratios(best, other)} of {other}'s" for other in others)
    return (
        f"**Given {QUESTIONS[question]}:** {best} {'leads' if second in undecided else 'wins'}. Its RMSE_a is {text} "
        f"({'by view, ' if len(views) > 1 else ''}the reference's noise removed), for {mean(best, 'oracle_rays') / max(mean(base, 'oracle_rays'), 1):.1f} times the oracle rays "
        f"and {mean(best, 'seconds') / mean(base, 'seconds'):.2f} times the seconds of {base}. "
        + (
            f"Undecided, by the intervals or the reference's noise: {', '.join(undecided)}."
            if undecided
            else "All differences from it are decided."
        )
    )


def _decided(results, question, a, b, view):
    """Do 95 % intervals of two oracles stay apart, the noise of the reference added to each?"""
    ends = []
    for label in (a, b):
        rows = _select(results, question, label, view)
        mean, half = interval([r["rmse_a_clean"] for r in rows])
        half = half if len(rows) > 1 else 0.0
        ends.append((mean, half + 1.96 * statistics.mean(r["rmse_a_clean_error"] for r in rows)))
    (x, dx), (y, dy) = ends
    return abs(x - y) > dx + dy


def _tables(results, labels):
    """Markdown tables: the paper's layout per question, costs, and error split into mesh and noise."""
    views = results["setting"]["views"]
    notes = [
        f"Reference of view {v}: {r['spp']} samples per pixel, its own RMSE_a is {r['noise']:.3f}."
        for v, r in results["reference"].items()
    ]
    yield "\n".join(notes)
    for question in ("mesh", "rays", "time"):
        present = _present(results, labels, question)
        if not present:
            continue
        yield f"## Given {QUESTIONS[question]}\n\n" + _error_table(results, present, question, views)
        yield _cost_table(results, present, question)
    present = _present(results, labels, "noise")
    if present:
        yield (
            f"## Where the error comes from\n\nRMSE_a² with the noise of the reference removed, split by rendering {QUESTIONS['noise'].split(':')[0]}.\n\n"
            + _split_table(results, present, views)
        )


def _error_table(results, labels, question, views):
    best = {}
    for view in views:
        for name in METRICS:
            means = {
                label: statistics.mean(r[name] for r in _select(results, question, label, view)) for label in labels
            }
            best[view, name] = (min if name.startswith("rmse") else max)(means, key=means.get)
    head = ["oracle"] + [f"{HEADINGS[name]} (view {view})" for view in views for name in METRICS]
    rows = []
    for label in labels:
        cells = [label]
        for view in views:
            for name in METRICS:
                mean, half = interval([r[name] for r in _select(results, question, label, view)])
                text = f"{mean:.3f}" + (f" ± {half:.3f}" if not math.isnan(half) else "")
                cells.append(f"**{text}**" if best[view, name] == label else text)
        rows.append(cells)
    return _markdown(head, rows)


def _cost_table(results, labels, question):
    def mean(label, name):
        return statistics.mean(r[name] for r in _select(results, question, label))

    names = ("elements", "pairs", "rays", "oracle_rays", "pilot_rays")
    return _markdown(
        ["oracle", *names, "rays in all", "seconds"],
        [
            [
                label,
                *(f"{mean(label, name):,.0f}" for name in names),
                f"{statistics.mean(cost(r, 'rays') for r in _select(results, question, label)):,.0f}",
                f"{mean(label, 'seconds'):.2f}",
            ]
            for label in labels
        ],
    )


def _split_table(results, labels, views):
    rows = []
    for label in labels:
        cells = [label]
        for view in views:
            seeds = {r["seed"] for r in _select(results, "noise", label, view)}
            few = statistics.mean(
                r["rmse_a_clean"] ** 2 for r in _select(results, "mesh", label, view) if r["seed"] in seeds
            )
            many = statistics.mean(r["rmse_a_clean"] ** 2 for r in _select(results, "noise", label, view))
            noise = max(few - many, 0) * MORE_RAYS / (MORE_RAYS - 1)
            cells += [f"{few**0.5:.3f}", f"{max(few - noise, 0) ** 0.5:.3f}", f"{noise**0.5:.3f}"]
        rows.append(cells)
    return _markdown(
        ["oracle"] + [f"{name} (view {v})" for v in views for name in ("RMSE_a", "of the mesh", "of the rays")], rows
    )


def _markdown(head, rows):
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


# ---- Pictures --------------------------------------------------------------------------------------


def _figure(output, labels, references):
    """Fig. 1: shaded first view and mesh of the last one, with error heat maps beside (PNG bytes)."""
    rows = [label for label in ROWS_OF_FIGURE if label in labels] or labels[:3]
    first, last = min(references), max(references)

    def picture(name):
        file = output / "images" / f"{name}.exr".replace(":", "")
        return np.array(mi.Bitmap(str(file)))[..., :3] if file.exists() else None

    plt = _matplotlib()
    figure, axes = plt.subplots(len(rows), 4, figsize=(16, 3.2 * len(rows)), squeeze=False, layout="constrained")
    shown = None
    for line, label in zip(axes, rows):
        panels = [
            (picture(f"{label}_view{first}"), f"{label}: view {first}"),
            (picture(f"{label}_view{last}_mesh"), f"mesh, view {last}"),
        ]
        for view in (first, last):
            image = picture(f"{label}_view{view}")
            error = None if image is None else np.abs(srgb(image) - srgb(references[view].image())).mean(axis=2)
            panels.append((error, f"error, view {view}"))
        for axis, (image, title) in zip(line, panels):
            axis.set_axis_off()
            axis.set_title(title, fontsize=10)
            if image is None:
                continue
            if image.ndim == 3:
                axis.imshow(srgb(image).astype(np.uint8))
            else:
                shown = axis.imshow(image, cmap="inferno", vmin=0, vmax=40)
    if shown is not None:
        figure.colorbar(shown, ax=axes[:, 2:].ravel().tolist(), shrink=0.6, label="|error| on 0…255")
    return _png(figure)


def _matplotlib():
    """matplotlib.pyplot without a screen."""
    try:
        import matplotlib
    except ImportError:
        raise RadiosityError("figures need matplotlib: pip install 'mi_radiosity[evaluation]'") from None
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _png(figure):
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    _matplotlib().close(figure)
    return buffer.getvalue()


def _page(results, labels, figure):
    """The whole report as one HTML file with its pictures inside."""

    def strong(text):
        return re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", html.escape(text))

    parts = []
    for block in _tables(results, labels):
        for piece in block.split("\n\n"):
            if piece.startswith("|"):
                lines = [[strong(c.strip()) for c in line.strip("|").split(" | ")] for line in piece.splitlines()]
                parts.append(
                    "<table><tr>"
                    + "".join(f"<th>{c}</th>" for c in lines[0])
                    + "</tr>"
                    + "".join("<tr>" + "".join(f"<td>{c}</td>" for c in line) + "</tr>" for line in lines[2:])
                    + "</table>"
                )
            elif piece.startswith("## "):
                parts.append(f"<h2>{html.escape(piece[3:])}</h2>")
            else:
                parts.append(f"<p>{strong(piece)}</p>")
    image = (
        f'<img src="data:image/png;base64,{base64.b64encode(figure).decode()}" alt="pictures and errors">'
        if figure
        else ""
    )
    head = "".join(f"<p class=verdict>{strong(line)}</p>" for line in verdicts(results, labels))
    title = f"Oracles compared on {html.escape(results['scene'])}"
    return f"""<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>
<style>body{{font:15px/1.45 system-ui,sans-serif;max-width:1200px;margin:2em auto;padding:0 1em}}table{{border-collapse:collapse;margin:1em 0;font-size:13px}}
td,th{{padding:.25em .6em;border-bottom:1px solid #ddd;text-align:right}}td:first-child,th:first-child{{text-align:left}}.verdict{{background:#f3f1ea;padding:.7em 1em}}img{{width:100%}}</style>
<h1>{title}</h1>{head}{image}{"".join(parts)}
<p>Versions: {html.escape(", ".join(f"{k} {v}" for k, v in results["versions"].items()))}. {results["setting"]["elements"]:,} elements, {results["setting"]["rays"]:,} rays, {results["setting"]["lines"]} lines per pair.</p></html>
"""
